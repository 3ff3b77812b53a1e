"""Installs the built wheel as a newcomer does, with all it needs, and meets it: version, recipes, demo, evaluation.

    python -m tools.wheel_in_empty_environment                           # the Python that runs this
    python -m tools.wheel_in_empty_environment python3.12 python3.13     # others, one after another
    python -m tools.wheel_in_empty_environment --uvx                     # uvx --from WHEEL tandem demo

Needs an index of packages within reach; takes minutes, so it is no test of the suite. Each environment is new and is
removed. Prints a line for every step: what was run, and for how long.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
STEPS = (
    ("--version",),
    ("configs",),
    ("demo", "--env-steps", "3000"),
    ("evaluate", "panda-cube@champion", "--episodes", "50"),
    ("methods",),
    ("serve", "--runs", "runs"),
    ("play",),
)
"""What is typed, one after another, in an empty directory."""
MISSING = {extra: f"pip install 'tandem-skills[{extra}]'" for extra in ("serve", "play")}
"""The answers to the last ones."""


def main() -> None:
    """Parse, build, install, run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pythons", nargs="*", default=[sys.executable], help="interpreters")
    parser.add_argument("--uvx", action="store_true", help="by uvx instead of pip, with the first interpreter")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tandem-wheel-") as directory:
        home = Path(directory)
        wheel = build_wheel(home)
        if options.uvx:
            uvx = shutil.which("uvx") or str(Path(sys.executable).with_name("uvx"))
            links = [word for link in os.environ.get("PIP_FIND_LINKS", "").split() for word in ("--find-links", link)]
            _meet([uvx, *links, "--python", options.pythons[0], "--from", str(wheel), "tandem"], home / "uvx")
            return
        for number, python in enumerate(options.pythons):
            venv = home / f"venv-{number}"
            _run([python, "-m", "venv", str(venv)], home)
            pip = [str(venv / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
            _run([*pip, str(wheel)], home)
            _meet([str(venv / "bin" / "tandem")], home / f"here-{number}")
            shutil.rmtree(venv)


def build_wheel(directory: Path) -> Path:
    """Build the wheel of this checkout into a directory."""
    source = directory / "source"
    for name in ("service", "tandem_skills", "configs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    options = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check")
    _run([sys.executable, "-m", "pip", "wheel", *options, "--wheel-dir", str(directory), str(source)], directory)
    (wheel,) = directory.glob("*.whl")
    return wheel


def _meet(tandem: list[str], here: Path) -> None:
    here.mkdir()
    for step in STEPS:
        _run([*tandem, *step], here, expected=2 if step[0] in MISSING else 0, said=MISSING.get(step[0], ""))


def _environment() -> dict[str, str]:
    """The environment of this process, without what would lead to this checkout."""
    ours = {"PYTHONPATH", "VIRTUAL_ENV", "TANDEM_REGISTRY", "TANDEM_RUNS"}
    return {key: value for key, value in os.environ.items() if key not in ours}


def _run(command: list[str], directory: Path, *, expected: int = 0, said: str = "") -> None:
    begun_s = time.monotonic()
    result = subprocess.run(command, cwd=directory, env=_environment(), capture_output=True, text=True, check=False)
    words = " ".join([Path(command[0]).name, *command[1:]]).splitlines()[0]
    print(f"{time.monotonic() - begun_s:7.1f} s  {words}", flush=True)
    if result.returncode != expected or said not in result.stderr:
        sys.exit(f"exit code {result.returncode}:\n{result.stdout}\n{result.stderr}")


if __name__ == "__main__":
    main()
