"""Options and output that several commands share, and the one way in which a user's error is reported."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from service.cli.unexpected import UsageError, traceback_in
from service.errors import TandemError, one_line

CHAMPION = "panda-cube@champion"
"""The primitives that come with the package."""
EXIT_SIGNAL = 128
"""Plus the signal's number: 130 for SIGINT, 143 for SIGTERM."""

RegistryOption = Annotated[
    Path, typer.Option("--registry", envvar="TANDEM_REGISTRY", metavar="DIR", help="Directory of the registry.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
REGISTRY = Path("registry")


class CommandGroup(TyperGroup):
    """A group of commands in which every error is one line on stderr and an exit code.

    The code is 2 if the error is a mistake in what was typed, or in a file that was named; else 1.
    """

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """Read what was typed."""
        with _one_line():
            return super().make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was typed."""
        with _one_line():
            return super().invoke(ctx)


@contextmanager
def _one_line() -> Iterator[None]:
    try:
        with traceback_in():
            yield
    except TandemError as error:
        typer.echo(f"error: {one_line(str(error))}", err=True)
        raise typer.Exit(error.exit_code) from None
    except UsageError as error:
        said: Any = error
        text = said.format_message().strip()
        if not text or "\n" in text:  # help, which was asked for by typing nothing; it may be printed already
            raise
        command = f"; see {said.ctx.command_path} --help" if said.ctx is not None else ""
        typer.echo(f"error: {one_line(text).rstrip('.')}{command}", err=True)
        raise typer.Exit(said.exit_code) from None


def how_to_go_on(run_dir: Path, registry: Path, *, runtime: str = "local", address: str | None = None) -> str:
    """The command that continues a run or a study, where it was begun."""
    place = ["--runtime", runtime] * (runtime != "local") + (["--address", address] if address is not None else [])
    command = ["tandem", "pretrain", "--resume", "--run-dir", str(run_dir), "--registry", str(registry), *place]
    return f"continue with: {shlex.join(command)}"


def print_json(tree: Any) -> None:
    """Print a tree of plain values."""
    typer.echo(json.dumps(tree, indent=1))


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table on a terminal, and lines of cells with tabs between elsewhere."""
    if not sys.stdout.isatty():
        for row in (header, *rows):
            typer.echo("\t".join(row))
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Column, Table

    table = Table(Column(header[0], no_wrap=True), *header[1:])  # what is typed again must stay in one piece
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    Console().print(table)
