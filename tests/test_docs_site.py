"""The docs site builds without a broken link, its reference is complete, and what the pages say to type works."""

import re
import shlex
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import typer

import tandem_skills
from service.base.errors import TandemError
from service.cli.main import app
from tests.cli.typed import tandem
from tests.methods.trials import SETS
from tools import docs_reference
from tools.docs_site import build

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
START = (ROOT / "docs" / "start.md").read_text()
SETTINGS = '[project]\nsite_name = "T"\nnav = ["index.md", {"R" = ["reference/*.md"]}]\n'


def small_site(root, text):
    (root / "docs").mkdir()
    (root / "docs" / "zensical.toml").write_text(SETTINGS)
    (root / "docs" / "index.md").write_text(text)
    (root / "docs" / "reference").mkdir()
    (root / "docs" / "reference" / "cli.md").write_text("# Commands\n")
    return root


@pytest.fixture
def no_other_pages(monkeypatch):
    monkeypatch.setattr("tools.docs_site.OUTSIDE", {})


@pytest.mark.skipif(find_spec("zensical") is None, reason="needs zensical, which needs Python 3.11.5")
def test_the_site_builds(tmp_path):
    site = build(tmp_path / "out")
    pages = {str(path.relative_to(site)) for path in site.rglob("*.html")}
    assert {
        "index.html",
        "start.html",
        "changelog.html",
        "reference/config.html",
        "decisions/0001-the-world.html",
    } <= pages
    world = (site / "decisions" / "0009-libraries-and-rooms.html").read_text()
    assert 'href="../changelog.html"' in world  # ../../CHANGELOG.md in the repository
    assert (site / "images" / "concepts.svg").is_file()
    elsewhere = re.findall(r'(?:src|<link[^>]*href)="(https?://[^"]*)', (site / "index.html").read_text())
    assert elsewhere == []  # nothing is fetched from another site


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[a](nothing.md)", "docs/index.md: link to nothing.md, which is not there"),
        ("![a](images/none.png)", "docs/index.md: link to images/none.png, which is not there"),
        ("[a](../../elsewhere.md)", "docs/index.md: link to ../../elsewhere.md, which is not there"),
        pytest.param(
            "[a](reference/cli.md#no-such-heading)",
            "anchor does not exist",
            marks=pytest.mark.skipif(find_spec("zensical") is None, reason="needs zensical"),
        ),
    ],
)
def test_a_link_to_nothing_is_refused(tmp_path, no_other_pages, text, said):
    with pytest.raises(TandemError, match=re.escape(said)):
        build(tmp_path / "out", small_site(tmp_path, f"# A\n\n{text}\n"))


def test_a_page_has_to_be_in_the_navigation(tmp_path, no_other_pages):
    root = small_site(tmp_path, "# A\n\n`[a](no-link.md)`\n")
    (root / "docs" / "lost.md").write_text("# Lost\n")
    with pytest.raises(TandemError, match=r"add to nav: lost\.md"):
        build(tmp_path / "out", root)


def test_every_command_and_option_is_in_the_reference():
    text = docs_reference.commands()
    for name, command in docs_reference.walk_commands(typer.main.get_command(app), "tandem"):
        section = text[text.index(f"# {name}\n") :].partition("\n#")[0]
        options = [
            option
            for each in command.params
            for option in each.opts
            if option.startswith("-") and not getattr(each, "hidden", False)
        ]
        assert [option for option in options if option not in section] == [], name


def test_every_key_is_in_the_reference():
    text = docs_reference.configuration()
    keys = [key for kind in docs_reference.method_classes() for key in docs_reference.keys(kind)]
    assert {"learner.bob.learning_rate", "skills.sac.tau", "reward_margin_m", "distillation.num_worlds"} <= set(keys)
    assert [key for key in keys if f"| `{key}` |" not in text] == []
    assert "| `world.num_substeps` | `20` | `8` | `>= 1`, `<= 200` | physics steps per action;" in text


def test_the_reference_is_that_of_this_code():
    pages = {name: (ROOT / "docs" / name).read_text() for name in docs_reference.pages()}
    assert pages == docs_reference.pages(), "python -m tools.docs_reference writes them anew"


def test_the_public_names_are_in_the_reference():
    text = docs_reference.api()
    for name in tandem_skills.__all__:
        assert f"### tandem.{name}\n" in text or f"### {name}\n" in text or name == "errors", name
    assert "- `reference`: NAME, NAME@ALIAS or NAME@VERSION; or the path of a run" in text
    assert "#### Trained.primitives\n" in text
    assert "- `ConfigError`: A configuration the user can mend;" in text
    assert "- `label: str`: Where it comes from, such as `panda-cube@3 (bundled)`." in text


def blocks(text, *languages):
    """Blocks of code in a page."""
    found = re.findall(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return [block for language, block in found if language in languages]


def commands(text):
    """The ``tandem`` commands in a page's blocks of code, without ``tandem``."""
    for block in blocks(text, "", "console"):
        prompt = "$ " if re.search(r"^\$ ", block, re.MULTILINE) else ""  # with one, other lines are answers
        for line in block.replace("\\\n", " ").splitlines():
            if line.startswith(f"{prompt}tandem "):
                yield shlex.split(line.removeprefix(prompt), comments=True)[1:]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_commands_in_pages_can_be_typed(page):
    """Every command and option in a page exists; no command is run."""
    for words in commands(page.read_text()):
        command, name = typer.main.get_command(app), "tandem"
        while words and words[0] in getattr(command, "commands", {}):
            command, name, words = command.commands[words[0]], f"{name} {words[0]}", words[1:]
        try:
            command.make_context(name, list(words))
        except typer.Exit:
            pass  # --version
        except Exception as error:
            pytest.fail(f"{name} {shlex.join(words)}: {error}")


def test_there_are_commands_to_type():
    verbs = {words[0] for words in commands(START)}
    assert verbs == {"--version", "demo", "evaluate", "play", "render", "train", "serve"}


@pytest.mark.usefixtures("no_artifacts")
def test_start_heres_task_is_learned_measured_and_loaded(tmp_path, monkeypatch):
    """Its commands, in order, with a tiny run; then what downstream.md does with the result."""
    monkeypatch.chdir(tmp_path)
    small = {"train": SETS, "evaluate": ["--episodes", "2"]}
    typed = [words for words in commands(START) if "wall" in words[1:2] or "runs/wall-ours-her-0" in words][:2]
    assert [words[0] for words in typed] == ["train", "evaluate"]
    for words in typed:
        result = tandem(*words, *small[words[0]])
        assert result.exit_code == 0, result.output
    *_, load = blocks((ROOT / "docs" / "downstream.md").read_text(), "python")
    assert '"wall-orchestrator@best"' in load
    code = load.replace("wall-orchestrator@best", typed[1][-1])
    names = {}
    exec(compile(code, "downstream.md", "exec"), names)
    assert names["action"].shape == (4, 4)  # of as many worlds


def test_the_task_that_is_shown_whole_is_the_example():
    shown, *_ = blocks((ROOT / "docs" / "own_task.md").read_text(), "python")
    assert (ROOT / "docs" / "examples" / "lift_and_hold.py").read_text().endswith(f'"""\n\n{shown}')
    assert len([line for line in shown.splitlines() if line]) == 15


def test_start_here_runs_as_a_program(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    measure, goal, mix, task = blocks(START, "python")
    assert "num_episodes=100" in measure
    exec(compile(measure.replace("num_episodes=100", "num_episodes=4"), "start.md", "exec"), {})
    assert re.match(r"Bob takes the cube to \d+% of them, within \d\.\d{3} m", capsys.readouterr().out)
    exec(compile(goal, "start.md", "exec"), {})
    found = re.fullmatch(r"the cube is (\d+\.\d) cm from the goal\n", capsys.readouterr().out)
    assert found is not None
    assert float(found[1]) < 5.0
    names = {}
    exec(compile(mix, "start.md", "exec"), names)
    assert (names["means"].shape, names["mean"].shape) == ((8, 4), (4,))
    assert not np.array_equal(names["observation"]["observation"], names["positions"])
    assert "learn(10_000)" in task
    names = {}
    exec(compile(task.replace("10_000", "110"), "start.md", "exec"), names)
    assert names["model"].num_timesteps == 110
    assert names["model"].action_space.shape == (names["trained"].primitives.num_primitives,)
