"""The command line, thin: parse, call, print. Heavy packages are imported inside the commands."""

from __future__ import annotations

import logging
import os
import threading

import typer

from service.cli.common import CommandGroup
from service.cli.downstream import downstream_app
from service.cli.evaluate import coverage, evaluate, render
from service.cli.export import export
from service.cli.pretrain import demo, pretrain
from service.cli.registry import registry_app
from service.cli.robot import robot_app
from service.cli.serve import serve
from service.cli.unexpected import report_thread_error

app = typer.Typer(
    name="tandem", help="Robot skills, pre-trained.", cls=CommandGroup, no_args_is_help=True, add_completion=False
)
for command in (pretrain, demo, evaluate, coverage, render, export, serve):
    app.command()(command)
app.add_typer(registry_app)
app.add_typer(downstream_app)
app.add_typer(robot_app)


def main() -> None:
    """Entry point of ``tandem`` and ``python -m service``."""
    # NumPy's and torch's own threads only get in each other's way: worlds are stepped by MuJoCo's threads. Both read
    # these variables when they are first imported, which is after this line.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    threading.excepthook = report_thread_error
    logging.getLogger("OpenGL").setLevel(logging.WARNING)  # says at INFO which optional module it does without
    app()
