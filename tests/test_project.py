"""The project as a whole: what an import costs, which way imports point, and whether the documents tell the truth."""

import ast
import functools
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import yaml

import service

ROOT = Path(__file__).parents[1]
HEAVY = (
    *("torch", "mujoco", "matplotlib", "gymnasium", "tensorboard", "imageio_ffmpeg", "ray", "redis", "fastapi"),
    *("uvicorn", "httpx", "onnx", "onnxruntime", "viser", "mjviser"),
)
CLUSTER_MODULES = (
    "actor_pool",
    "self_play",
    "ray_actors",
    "ray_task",
    "ray_connection",
    "remote_worker",
    "status_actor",
    "watch",
    "worker_variables",
)
ROOMS_WITHOUT_TORCH = ("actors", "base", "config", "envs", "generator", "registry", "robot/play", "status", "store")
ROOMS = (
    *("base", "config", "store", "envs", "policies", "generator", "actors", "learner", "registry", "media"),
    *("methods", "export", "robot", "status", "runs", "cluster", "cli", "__main__", "service"),
)
"""Each room may import itself and those before it."""
VERBS = (
    "demo", "train", "publish", "methods", "tasks", "pretrain", "evaluate", "render", "play", "coverage",
    "dataset", "export", "registry", "serve", "robot", "configs", "doctor",
)  # fmt: skip
DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md")), ROOT / "deploy" / "README.md"]
FOLDERS = (".ci", "benchmarks", "configs", "deploy", "docs", "service", "tandem_skills", "tests", "tools")
TEXT = {".cfg", ".json", ".jsonl", ".md", ".py", ".toml", ".txt", ".yaml", ".yml", ""}

IMPORT_ALL = """
import importlib, sys
forbidden, modules = sys.argv[1].split(","), sys.argv[2].split(",")
for module in modules:
    importlib.import_module(module)
    found = [name for name in forbidden if name in sys.modules]
    if found:
        sys.exit(f"importing {module} brings in {', '.join(found)}")
"""

HELP = """
import runpy, sys
forbidden, sys.argv = sys.argv[1].split(","), ["tandem", "--help"]
try:
    runpy.run_module("service", run_name="__main__")
except SystemExit as stop:
    assert not stop.code, stop.code
found = [name for name in forbidden if name in sys.modules]
if found:
    sys.exit(f"tandem --help brings in {', '.join(found)}")
"""


def run_python(code, *args):
    """Run code in a fresh interpreter; returns what it printed."""
    environment = {**os.environ, "NO_COLOR": "1", "COLUMNS": "120"}
    result = subprocess.run(
        [sys.executable, "-c", code, *args], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def modules_in(room):
    """Names of the modules of one room, its package first."""
    paths = sorted((ROOT / "service" / room).rglob("*.py"))
    return [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths]


def text_files():
    """Every text file of the project, without what is generated and without the registry's tensors."""
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*")] + list(ROOT.glob("*"))
    paths = [path for path in paths if path.is_file() and path.suffix in TEXT and path.name != ".git"]
    return [path for path in paths if not {"__pycache__", "blobs"} & set(path.parts)]


def project_table():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_import_is_light():
    run_python(IMPORT_ALL, ",".join(HEAVY), "service,service.config,service.base.errors,service.cli")


def test_help_is_light_and_names_every_verb():
    text = run_python(HELP, ",".join(HEAVY))
    assert [verb for verb in VERBS if not re.search(rf"^\W*{verb}\b", text, re.MULTILINE)] == []


THREADS = """
import os, sys

class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            print(os.environ.get("OPENBLAS_NUM_THREADS"), os.environ.get("OMP_NUM_THREADS"))

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.pop(name, None)
sys.meta_path.insert(0, Watch())
import service.cli.main, numpy
"""


def test_commands_ask_for_one_thread_before_numpy_is_imported():
    assert run_python(THREADS).split() == ["1", "1"]


def test_acting_needs_no_torch():
    rooms = [modules_in(room) for room in ROOMS_WITHOUT_TORCH]
    assert all(rooms)
    others = ["service.policies.numpy_policy", "service.runs.train"]
    run_python(IMPORT_ALL, "torch", ",".join([*others, *(module for room in rooms for module in room)]))


@functools.cache
def trees():
    """The syntax tree of every file in service."""
    return {path: ast.parse(path.read_text()) for path in sorted((ROOT / "service").rglob("*.py"))}


@functools.cache
def imports_of_modules():
    """Every import in service, those inside functions and for types included: (importing, imported module) by name."""
    modules, found = dict(zip(modules_in(""), trees().items(), strict=True)), []
    for name, (path, tree) in modules.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                found += [(name, alias.name) for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, f"{path} line {node.lineno}: relative import"
                whole = [f"{node.module}.{alias.name}" for alias in node.names]
                found += [(name, each if each in modules else node.module) for each in whole]
    return found


def room_of(module):
    """``service`` itself, the public API, is the last room: it may import any, and none may import it."""
    return module.split(".")[1] if "." in module else module


def test_imports_run_only_down():
    ours = [pair for pair in imports_of_modules() if pair[1].split(".")[0] == "service"]
    assert {room_of(module) for pair in ours for module in pair} == set(ROOMS)
    upwards = {(one, other) for one, other in ours if ROOMS.index(room_of(other)) > ROOMS.index(room_of(one))}
    assert upwards == set()


def test_no_import_circle():
    waiting = {}
    for one, other in imports_of_modules():
        if other.split(".")[0] == "service" and one != other:
            waiting.setdefault(one, set()).add(other)
    while free := {module for module, imported in waiting.items() if not imported & waiting.keys()}:
        waiting = {module: imported for module, imported in waiting.items() if module not in free}
    assert waiting == {}


def test_only_the_cluster_knows_ray_and_only_the_store_knows_redis():
    users = {(other.split(".")[0], one) for one, other in imports_of_modules()}
    with_ray = {f"service.cluster.{name}" for name in CLUSTER_MODULES}
    assert {one for package, one in users if package == "ray"} == with_ray
    assert {room_of(one) for package, one in users if package == "redis"} == {"store"}


OPENS_OR_PARSES = re.compile(
    r"(.*\.)?(open|read_text|read_bytes|FileIO|model_validate_json)|np\.(load|loadtxt|fromfile)|yaml\.\w*load"
    r"|json\.loads?|msgspec\.json\.(decode|Decoder)"
)
ALLOWED = {
    "service/base/files.py": {"open", "os.open", "FileIO"},
    "service/base/parsing.py": {"yaml.load"},
    "service/store/tail.py": {"msgspec.json.Decoder"},  # which parse_with calls
    # what comes with the package, or is the kernel's
    "service/config/recipes.py": {"path.read_text"},
    "service/cli/configs.py": {"known[name].read_text"},
    "service/cli/doctor.py": {"Path('/proc/meminfo').read_text"},
    "service/export/formats.py": {"Path(forward.__file__).read_text"},
    "service/policies/forward.py": {"np.load"},  # runs where this package is not
    "service/runs/signals.py": {"os.open"},
    "service/cli/common.py": {"open"},  # makes a file that must not be there yet
}
"""Where files are opened and texts are parsed, and why it is not by the functions that all others use."""


def test_one_module_opens_what_others_wrote_and_one_parses_it():
    """There a FIFO is not waited for, a device not read for ever, and a deep text ends with no RecursionError."""
    found = {}
    for path, tree in trees().items():
        calls = (ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call))
        if used := {call for call in calls if OPENS_OR_PARSES.fullmatch(call)}:
            found[str(path.relative_to(ROOT))] = used
    assert found == ALLOWED


def test_no_module_is_long():
    lengths = {path: len(path.read_text().splitlines()) for path in (ROOT / "service").rglob("*.py")}
    assert lengths
    assert {str(path.relative_to(ROOT)): lines for path, lines in lengths.items() if lines > 500} == {}


def test_one_version_everywhere():
    latest = re.search(r"^## \[([^\]]+)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert latest is not None
    assert project_table()["version"] == latest[1] == service.__version__ == citation()["version"]


def citation():
    return yaml.safe_load((ROOT / "CITATION.cff").read_text())


def test_a_citation_credits_this_project():
    """With ``preferred-citation`` the paper would be cited in its place, which is by others."""
    assert "preferred-citation" not in citation()
    assert citation()["title"].startswith("Tandem: ")
    assert [each["url"] for each in citation()["references"]] == ["https://arxiv.org/abs/2410.04855"]


def test_mujoco_has_an_upper_bound():
    (mujoco,) = [line for line in project_table()["dependencies"] if line.startswith("mujoco")]
    assert "<" in mujoco


def test_links_lead_somewhere():
    dead = []
    for document in DOCUMENTS:
        text = re.sub(r"```.*?```", "", document.read_text(), flags=re.DOTALL)
        targets = re.findall(r"\]\(([^)\s#]+)", text)
        local = [target for target in targets if "://" not in target and not target.startswith("mailto:")]
        dead += [(document, target) for target in local if not (document.parent / target).exists()]
    assert dead == []


def test_the_readme_begins_with_commands_that_exist():
    text = (ROOT / "README.md").read_text()
    first = re.search(r"```\n(.*?)```", text, re.DOTALL)
    assert first is not None
    lines = [line.partition("#")[0].split() for line in first[1].splitlines()]
    assert [line[:2] for line in lines] == [["git", "clone"], ["cd", "tandem"], ["make", "demo"], ["make", "test"]]
    beside = re.findall(r"^\| `(make [a-z]+)` \| about [a-z]+ minutes\b[^|]* \| [^|]+ \|$", text, re.MULTILINE)
    assert beside == ["make demo", "make test"]  # how long it takes, and what it ends with
    phony = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert phony is not None
    assert set(re.findall(r"(?:^|`)make ([a-z]+)", text, re.MULTILINE)) <= set(phony[1].split())
    commands = set(re.findall(r"(?:^ *|`)tandem ([a-z]+)", text, re.MULTILINE))
    assert commands
    assert commands <= set(VERBS)


def test_the_readme_is_short():
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 120
    assert [line for line in lines if len(line) > 160 and not line.startswith("|")] == []


def test_no_page_installs_from_an_index():
    """No index has the package: a page that names it to an installer sends readers to nothing, or to a stranger's."""
    installer = r"(?:pip3? install|pipx|uvx|uv (?:tool|add|pip))"
    for document in DOCUMENTS:
        text = document.read_text()
        assert re.findall(rf"\b{installer}\b[^\n`]*\btandem-skills\b.*", text) == [], document
        assert set(re.findall(r"tandem_skills-(.+?)-py3", text)) <= {service.__version__}, document


def test_ci_runs_what_the_readme_says():
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    lines = [line for line in script.read_text().splitlines() if line and not line.startswith("#")]
    assert lines[:2] == ["set -euo pipefail", 'cd "$(dirname "${BASH_SOURCE[0]}")/.."']
    assert lines[-1] == "make test"  # between them: what the machine lacks is installed
    assert [line for line in lines if "make" in line or "pytest" in line] == ["make test"]


def test_no_path_of_somebodys_machine():
    absolute = re.compile(r"""(?:^|[\s"'`=(:])/(?:home|root|Users|work|opt|mnt|data|farm)/\S+""")
    hits = [
        (str(path.relative_to(ROOT)), match[0])
        for path in text_files()
        for match in absolute.finditer(path.read_text())
    ]
    assert hits == []


def test_ascii_only():
    files = [path for path in text_files() if path.suffix in {".py", ".toml", ".yaml", ".md"}]
    assert len(files) > len(DOCUMENTS)
    assert [str(path.relative_to(ROOT)) for path in files if not path.read_bytes().isascii()] == []
