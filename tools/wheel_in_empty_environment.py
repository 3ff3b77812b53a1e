"""Installs the built wheel as a newcomer does, with all it needs, and meets it: version, recipes, demo, evaluation.

    python -m tools.wheel_in_empty_environment                           # the Python that runs this
    python -m tools.wheel_in_empty_environment python3.12 python3.13     # others, one after another
    python -m tools.wheel_in_empty_environment --uvx                     # uvx --from WHEEL tandem demo
    python -m tools.wheel_in_empty_environment --walk                    # docs/start.md, with its extras

Needs an index of packages within reach; takes minutes, so it is no test of the suite. Each environment is new and is
removed. Prints a line for every step: what was run, and for how long.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

ROOT = Path(__file__).parents[1]
WAIT_S = 120
"""For a server to answer, and to end."""
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
WALK = (
    ("--version",),
    ("demo", "--env-steps", "3000"),
    ("demo", "--env-steps", "3000"),  # another one, to compare
    ("evaluate", "panda-cube@champion", "--goals", "mixed", "--episodes", "100"),
    ("render", "--goals", "0.1,0.1,0.25; -0.1,0,0.025", "--out", "mine.mp4"),
)
"""What docs/start.md has one type, the demo shorter; then come its snippets and its two servers."""
SERVERS = ((("play", "--port", "8331"), "/"), (("serve", "--runs", "runs", "--port", "8332"), "/v1/runs"))
"""Each with the path that must answer."""


def main() -> None:
    """Parse, build, install, run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pythons", nargs="*", default=[sys.executable], help="interpreters")
    parser.add_argument("--uvx", action="store_true", help="by uvx instead of pip, with the first interpreter")
    parser.add_argument("--walk", action="store_true", help="all of docs/start.md, with the extras it names")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tandem-wheel-") as directory:
        home = Path(directory)
        wheel = build_wheel(home)
        if options.uvx:
            uvx = shutil.which("uvx") or str(Path(sys.executable).with_name("uvx"))
            links = [word for link in os.environ.get("PIP_FIND_LINKS", "").split() for word in ("--find-links", link)]
            _meet(
                [uvx, *links, "--python", options.pythons[0], "--from", str(wheel), "tandem"],
                home / "uvx",
            )
            return
        for number, python in enumerate(options.pythons):
            venv = home / f"venv-{number}"
            _run([python, "-m", "venv", str(venv)], home)
            pip = [str(venv / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
            _run([*pip, f"{wheel}[serve,play,downstream]" if options.walk else str(wheel)], home)
            (_walk if options.walk else _meet)([str(venv / "bin" / "tandem")], home / f"here-{number}")
            shutil.rmtree(venv)


def build_wheel(directory: Path) -> Path:
    """Build the wheel of this checkout into a directory."""
    source = directory / "source"
    for name in ("service", "configs"):
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


def _walk(tandem: list[str], here: Path) -> None:
    here.mkdir()
    for step in WALK:
        _run([*tandem, *step], here)
    for snippet in re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "start.md").read_text(), re.DOTALL):
        _run([str(Path(tandem[0]).with_name("python")), "-c", snippet.replace("10_000", "200")], here)
    for arguments, path in SERVERS:
        _serve([*tandem, *arguments], f"http://127.0.0.1:{arguments[-1]}{path}", here)


def _serve(command: list[str], url: str, here: Path) -> None:
    """Start a server, read a page of it, and end it by Ctrl-C."""
    begun_s = time.monotonic()
    with subprocess.Popen(command, cwd=here, env=_environment(), stdout=subprocess.DEVNULL) as server:
        for _ in range(WAIT_S):
            with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=10) as page:
                size = len(page.read())
                break
            time.sleep(1.0)
        else:
            sys.exit(f"nothing at {url} after {WAIT_S} s")
        server.send_signal(signal.SIGINT)
        if (code := server.wait(timeout=WAIT_S)) not in (0, 130):  # 130: ended by Ctrl-C, as shells have it
            sys.exit(f"{' '.join(command)} ended with {code}")
    print(f"{time.monotonic() - begun_s:7.1f} s  {' '.join(command[1:])}: {size:,} bytes at {url}", flush=True)


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
