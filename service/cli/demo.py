"""``tandem demo``: a robot arm teaches itself, and can be watched from the first minute."""

from __future__ import annotations

import importlib.util
import os
import shlex
import socket
import subprocess
import sys
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.base.errors import TandemError
from service.base.ports import free_port
from service.base.progress import answer
from service.cli.common import CHAMPION, QuietOption, how_to_go_on
from service.cli.train import train_and_tell
from service.config import load_config
from service.config.recipes import DEFAULT_RECIPE, recipes
from service.runs.signals import PARENT
from service.store.run_directory import RunDirectory

if TYPE_CHECKING:
    from service.runs.run import Ending

SOLVED, TIMES = 0.8, 2
"""It ends once so many of 100 random goals were solved so often in a row."""
_SUCCESS = "evaluation/mixed_success_last"


class Until:
    """Tells a run to end: Bob solves what he is asked for, or the time is over."""

    def __init__(self, minutes: float) -> None:
        self._rates: list[float] = []
        self.is_solved = self.is_late = False
        """Whether Bob solves enough; whether the time is over."""
        self._end_s = time.monotonic() + 60.0 * minutes

    def __call__(self, metrics: dict[str, float]) -> Ending | None:
        """Take in an iteration's metrics."""
        if _SUCCESS in metrics:
            self._rates.append(metrics[_SUCCESS])
        newest = self._rates[-TIMES:]
        self.is_solved = len(newest) == TIMES and min(newest) >= SOLVED
        if self.is_solved:
            return "converged"
        self.is_late = time.monotonic() >= self._end_s
        return "finished" if self.is_late else None


def demo(
    run_dir: Annotated[Path | None, typer.Option(metavar="DIR", help="Default: runs/demo-N.")] = None,
    minutes: Annotated[float, typer.Option(help="It ends sooner when Bob solves four of five goals.", min=0)] = 8.0,
    env_steps: Annotated[int | None, typer.Option(help="Budget; default: that of the recipe.", min=1)] = None,
    seed: Annotated[int, typer.Option(help="Of the run.", min=0)] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Show the live world while it learns, in a browser.")
    ] = True,
    quiet: QuietOption = False,
) -> None:
    """Watch a robot arm teach itself: a small pre-training from scratch, live in the browser."""
    runs = Path(os.environ.get("TANDEM_RUNS", "runs"))  # as tandem serve and tandem train have it
    paths = (runs / f"demo-{number}" for number in count(1))
    path = run_dir or next(path for path in paths if not path.exists())
    if RunDirectory(path).exists:
        raise TandemError(
            f"{path} holds a run already, and a demo begins a new one: leave --run-dir out, or name another; or "
            f"{how_to_go_on(path, path / 'registry')}"
        )
    typer.echo("A robot arm is about to teach itself: Alice proposes goals, Bob learns to reach them.")
    # Saved every few seconds, so that a newer Bob can be watched; evaluations take a twentieth of the time.
    overrides = [f"seed={seed}", "name=panda-cube-demo", "run.evaluation_interval=60", "run.checkpoint_interval=10"]
    overrides += [f"run.total_env_steps={env_steps}"] if env_steps is not None else []
    config = load_config(recipes()[DEFAULT_RECIPE], overrides)
    ends = Until(minutes)
    with _watched(path, wanted=browser) as look:

        def tell(metrics: dict[str, float]) -> Ending | None:
            look()  # by now there is a Bob to be watched, who knows nothing
            return ends(metrics)

        done = train_and_tell(config, RunDirectory(path), path / "registry", resume=False, until=tell)
        solved = done.metrics.get(_SUCCESS)
        late = f"{minutes:g} minutes are over" if ends.is_late else f"It is {done.reason}"
        why = "Bob solves four of five random goals, twice in a row" if ends.is_solved else late
        others = "" if solved is None else f" Of {config.run.final_episodes} others he solves {solved:.0%}."
        typer.echo(f"\n{why}.{others}")
        typer.echo("\nNow a task of your own, in fifteen lines: docs/own_task.md. Or look at what there is:")
        commands = [
            shlex.join(["play", str(path)]),
            shlex.join(["serve", "--runs", str(path.parent)]),
            f"play     {CHAMPION}",
            f"evaluate {CHAMPION} --goals mixed --episodes 300",
        ]
        typer.echo("\n".join(f"  tandem {command}" for command in commands))
        if (url := look()) and sys.stdin.isatty():
            typer.echo(f"\nThe live world stays at {url}; Enter ends it.")
            sys.stdin.readline()


@contextmanager
def _watched(path: Path, *, wanted: bool) -> Iterator[Callable[[], str]]:
    """Show a run in a process of its own, from the first call of what is given; that gives the address once it answers.

    Whether it is there is said once, so it has to be called now and then.
    """
    process: subprocess.Popen[bytes] | None = None
    there = all(importlib.util.find_spec(name) for name in ("viser", "mjviser"))
    port, told = 0, not (wanted and there)
    if wanted and not there:
        answer("to watch it in the browser: pip install 'tandem-skills[play]'")

    def look() -> str:
        nonlocal process, port, told
        if process is None and not told:
            from service.robot.play.server import PORT

            port = free_port("127.0.0.1", PORT)
            command = ["play", str(path), "--registry", str(path / "registry"), "--port", str(port)]
            process = subprocess.Popen(  # a nice one: what learns comes first
                ["nice", "-n", "5", sys.executable, "-m", "service", *command], start_new_session=True,
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                env={**os.environ, PARENT: str(os.getpid())},
            )  # fmt: skip
        is_on, url = process is not None and process.poll() is None, f"http://127.0.0.1:{port}"
        if told:
            return url if is_on else ""
        with suppress(OSError):
            socket.create_connection(("127.0.0.1", port), timeout=0.2).close()
            told = True
        if not is_on:
            told = True
            answer(f"the live world ended; this says why: tandem play {path}")
        elif told:
            answer(f"watch it at {url}: drag the goal, and see whether Bob can")
            if sys.stdout.isatty() and (sys.platform == "darwin" or os.environ.get("DISPLAY")):
                webbrowser.open_new_tab(url)
        return ""

    try:
        yield look
    finally:
        if process is not None:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(10.0)
            process.kill()
