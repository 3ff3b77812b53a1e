"""The command line, thin: parse, call, print. Heavy packages are imported inside the commands."""

from __future__ import annotations

import logging
import sys
from typing import Annotated

import typer

from service.base.version import __version__
from service.cli.common import CommandGroup, QuietOption, quieten
from service.cli.configs import configs_app, methods, tasks
from service.cli.demo import demo
from service.cli.doctor import doctor
from service.cli.evaluate import coverage, evaluate, render
from service.cli.export import dataset, export
from service.cli.registry import publish, registry_app
from service.cli.robot import robot_app
from service.cli.serve import play, serve
from service.cli.train import TrainCommand, train
from service.runs.signals import stop_with_parent

app = typer.Typer(name="tandem", help="Robot skills, pre-trained.", cls=CommandGroup, no_args_is_help=True)
app.command(cls=TrainCommand)(train)
app.command("pretrain", cls=TrainCommand, help="The same as tandem train, by its name for self-play.")(train)
for command in (demo, evaluate, coverage, render, play, dataset, export, publish, serve, methods, tasks, doctor):
    app.command()(command)
app.add_typer(registry_app)
app.add_typer(robot_app)
app.add_typer(configs_app)


def _say_version(asked: bool) -> None:
    if asked:
        typer.echo(f"tandem {__version__}")
        raise typer.Exit


@app.callback()
def options(
    quiet: QuietOption = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Robot skills, pre-trained."""
    quieten(quiet)  # again: when the option was read, nothing was there to be quiet


class _Log(logging.Handler):
    """Writes to what ``sys.stderr`` is at the moment: while something moves there, lines go above it."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line."""
        try:
            print(self.format(record), file=sys.stderr, flush=True)
        except Exception:
            self.handleError(record)


def main() -> None:
    """Entry point of ``tandem`` and ``python -m service``."""
    stop_with_parent()
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[_Log()])
    for name in ("OpenGL", "httpx", "torch"):  # at INFO they say much that nobody asked for
        logging.getLogger(name).setLevel(logging.WARNING)
    app()
