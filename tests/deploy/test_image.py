"""The Dockerfile, read line by line. ``tools/deployed.py`` builds it, which takes too long for a test."""

import re
import shlex
import subprocess
import sys
import tomllib

from tests.deploy.files import DEPLOY, ROOT, check_syntax


def instructions():
    """The instructions, continued lines joined as Docker does, comments left out."""
    text = (DEPLOY / "docker" / "Dockerfile").read_text()
    text = re.sub(r"^#.*\n", "", text, flags=re.MULTILINE).replace("\\\n", "")
    return [tuple(line.split(maxsplit=1)) for line in text.splitlines() if line.strip()]


def stages():
    """Every stage's base and instructions, by name; the last has none."""
    found, current = {}, None
    for word, rest in instructions():
        if word == "FROM":
            base, _, name = rest.partition(" AS ")
            current = []
            found[name] = (base, current)
        elif current is not None:
            current.append((word, rest))
    return found


def shell(rest):
    """A RUN's command, without the options of RUN itself."""
    return re.sub(r"^(--\S+\s+)+", "", rest)


def ignored(path):
    """Whether .dockerignore keeps a path of the repository out: it keeps everything out but what it names."""
    lines = (ROOT / ".dockerignore").read_text().split()
    assert "*" in lines
    return f"!{path.split('/')[0]}" not in lines


def test_indexes_are_arguments():
    values = {rest.split("=")[0]: rest.split("=")[1] for word, rest in stages()["packages"][1] if word == "ARG"}
    assert values == {
        "TORCH_INDEX": "https://download.pytorch.org/whl/cpu", "PIP_INDEX_URL": "https://pypi.org/simple",
    }  # fmt: skip
    (run,) = [shell(rest) for word, rest in stages()["packages"][1] if word == "RUN"]
    assert '--index-url "$TORCH_INDEX" --no-deps torch' in run  # pip takes the other from the environment


def test_stages_build_on_stages():
    known = set()
    for name, (base, body) in stages().items():
        assert base in known or base == "${PYTHON}", base
        sources = [match for _, rest in body for match in re.findall(r"(?:--from=|,?from=)([a-z]+)", rest)]
        assert set(sources) <= known
        known.add(name)


def test_what_is_copied_is_there_and_not_ignored():
    copied = [shlex.split(rest)[:-1] for word, rest in instructions() if word == "COPY" and "--from" not in rest]
    names = {name for group in copied for name in group}
    assert names == {
        "LICENSE",
        "README.md",
        "configs",
        "constraints.txt",
        "pyproject.toml",
        "service",
        "setup.py",
        "tandem_skills",
    }
    assert all((ROOT / name).exists() and not ignored(name) for name in names)


def test_what_must_not_be_in_an_image_is_ignored():
    assert all(map(ignored, [".env", "deploy/compose/.env", "runs", ".git", ".venv", "registry", "tests"]))


def test_versions_are_pinned():
    installs = [each for _, rest in instructions() for each in re.findall(r"pip (?:install|wheel) ([^&]*)", rest)]
    assert len(installs) == 4
    for install in installs:
        assert "-c constraints.txt" in install or "--no-deps" in install
    assert re.search(r"^torch==", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    (python,) = [rest for word, rest in instructions() if word == "ARG" and rest.startswith("PYTHON=")]
    assert re.fullmatch(r"PYTHON=python:3\.\d+-slim-\w+", python)


def test_the_requirements_are_the_projects(tmp_path):
    (run,) = [shell(rest) for word, rest in instructions() if word == "RUN" and "requirements.txt" in rest]
    (code,) = re.findall(r'python -c "(.*?)" >', run)
    printed = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=600, check=True
    ).stdout
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    itself, *of_ray = project["optional-dependencies"]["cluster"]
    assert itself == "tandem-skills[serve]"  # pip would look for it elsewhere
    assert printed.splitlines() == project["dependencies"] + project["optional-dependencies"]["serve"] + of_ray


def test_it_does_not_run_as_root():
    word_of = [word for word, _ in stages()[""][1]]
    assert dict(stages()[""][1])["USER"] == "1000:1000"
    assert "RUN" not in word_of[word_of.index("USER") :]
    assert dict(stages()[""][1])["ENTRYPOINT"] == '["tandem"]'


def test_commands_are_shell():
    for script in (shell(rest) for word, rest in instructions() if word == "RUN"):
        check_syntax(script)
