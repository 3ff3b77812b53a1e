"""Options and output that several commands share, and the one way in which a user's error is reported."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from service.errors import TandemError

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
    """A group of commands in which a ``TandemError`` is one line on stderr and an exit code.

    The code is 2 if the error is a mistake in what was typed.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was typed."""
        try:
            return super().invoke(ctx)
        except TandemError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(error.exit_code) from None


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
