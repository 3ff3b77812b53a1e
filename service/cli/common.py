"""Options and output that several commands share, and the one way in which a user's error is reported."""

from __future__ import annotations

import errno
import json
import logging
import os
import platform
import re
import shlex
import sys
import tempfile
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from service.base.errors import (
    TRACEBACK_PREFIX,
    NoRoomError,
    TandemError,
    UnexpectedError,
    did_you_mean,
    one_line,
)
from service.base.progress import Activity, Display, display, doing
from service.base.version import __version__
from service.envs.tasks import TASKS
from service.runs.signals import InterruptError

UsageError: type[Exception] = typer.BadParameter.__bases__[0]
"""The error of arguments that typer cannot read; it has no public name in all versions of typer."""
_PATH_ERRORS = (errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR)
"""Reasons for which a path that was typed cannot be used."""
CHAMPION = "panda-cube@champion"
"""The primitives that come with the package."""
EXIT_SIGNAL = 128
"""Plus the signal's number: 130 for SIGINT, 143 for SIGTERM, 129 for SIGHUP."""


def _of_this_machine(value: Path) -> Path:
    if str(value).startswith(("http:", "https:")):
        url = str(value).replace(":/", "://", 1)  # a path has single slashes
        raise typer.BadParameter(f"{url} is a service; give the directory of a registry", param_hint="--registry")
    return value


RegistryOption = Annotated[
    Path,
    typer.Option(
        "--registry",
        envvar="TANDEM_REGISTRY",
        metavar="DIR",
        help="Directory of the registry.",
        callback=_of_this_machine,
    ),
]
SourceOption = Annotated[
    str,
    typer.Option(
        "--registry", envvar="TANDEM_REGISTRY", metavar="DIR|URL", help="Where versions are: a registry or its service."
    ),
]
SOURCE = "registry"
REFERENCE = "NAME@ALIAS|PATH"
"""What ``load`` takes, as help has it."""
ReferenceArgument = Annotated[
    str,
    typer.Argument(
        metavar=REFERENCE,
        show_default=False,
        help=f"A version, or the path of a run, a checkpoint or an exported version. Default: {CHAMPION}.",
    ),
]
ActsWithOption = Annotated[
    str | None,
    typer.Option(
        "--primitives",
        metavar=REFERENCE,
        help="New place of the primitives or skills that a task's policy uses, if they moved.",
    ),
]
TaskOption = Annotated[
    str | None,
    typer.Option(autocompletion=lambda: [*TASKS], help="On a task of tandem tasks, such as wall, or of FILE.py."),
]


def quieten(quiet: bool) -> bool:
    """Show no progress from now on, if so, and print no messages but warnings and errors; a run's log has all."""
    shown = display()
    if quiet and shown is not None:
        shown.quiet = True
        for handler in logging.getLogger().handlers:
            handler.setLevel(logging.WARNING)
    return quiet


QuietOption = Annotated[bool, typer.Option("--quiet", "-q", callback=quieten, help="Show no progress.")]
TrackerOption = Annotated[
    list[str] | None,
    typer.Option(
        "--tracker", metavar="MODULE:FACTORY", help="Where metrics go, too, such as Weights & Biases; repeatable."
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
REGISTRY = Path("registry")
MAX_CELL = 100_000
"""Characters of a cell of a table."""


def shown() -> Display:
    """The display of this process."""
    found = display()
    assert found is not None, "CommandGroup opens it"
    return found


def choose(option: str, name: str, known: Iterable[str]) -> str:
    """Check a name that was typed.

    Args:
        option: it was typed for, such as ``--goals``.
        name: as it was typed.
        known: names that there are.

    Raises:
        TandemError: it is none of them.
    """
    names = list(known)
    if name not in names:
        raise TandemError(f"{option} {name!r}: choose one of {', '.join(names)}{did_you_mean(name, names)}")
    return name


RunCodeOption = Annotated[
    bool, typer.Option("--run-task-code", help="Run the code that a published policy's own task brings.")
]


def was_typed(context: typer.Context, name: str) -> bool:
    """Whether an option was typed, and has not its default or what a variable says."""
    source = context.get_parameter_source("start_from" if name == "from" else name)
    return source is not None and source.name == "COMMANDLINE"  # typer has a ParameterSource of its own


def typed_options(context: typer.Context, names: Sequence[str]) -> list[str]:
    """Those options of ``names`` that were typed, as one would type them."""
    words: list[str] = []
    for name in names:
        if was_typed(context, name):
            option, value = name.replace("_", "-"), context.params[name]
            if isinstance(value, bool):
                words.append(f"--{option}" if value else f"--no-{option}")
            else:
                words += [
                    word
                    for each in (value if isinstance(value, list | tuple) else [value])
                    for word in (f"--{option}", str(each))
                ]
    return words


def loading() -> AbstractContextManager[Activity]:
    """Show that packages and parameters are being loaded, which takes seconds on a busy machine."""
    return doing("loading", aloud=False)


class Terminal(Console):
    """A terminal, or what is in its place, that may go away or be full: then a command goes on without a word."""

    def on_broken_pipe(self) -> None:
        """Say nothing more; rich would end the process."""
        self.quiet = True

    def _check_buffer(self) -> None:
        """Leave out what cannot be written, as on a full disk or a terminal that is gone; rich would raise."""
        try:
            super()._check_buffer()
        except OSError:
            del self._buffer[:]


class CommandGroup(TyperGroup):
    """A group of commands in which every error is one line on stderr and an exit code.

    The code is 2 if the error is a mistake in what was typed, or in a file that was named; else 1.
    """

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """Read what was typed; nothing that can be typed means something when it is empty."""
        with _one_line():
            for before, argument in zip(["", *args], args, strict=False):
                if argument == "" or re.fullmatch(r"--[a-z-]+=", argument):
                    raise TandemError(
                        f"{argument or before or 'the first word'}: an argument is empty; is a variable of the shell "
                        "not set? Give it a value, or leave it out"
                    )
            return super().make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was typed; progress is shown on stderr."""
        with _one_line(), nullcontext() if display() is not None else Display(Terminal(stderr=True)):
            return super().invoke(ctx)


@contextmanager
def _one_line() -> Iterator[None]:
    try:
        with traceback_in():
            yield
    except TandemError as error:
        typer.echo(f"error: {one_line(str(error))}", err=True)
        raise typer.Exit(error.exit_code) from None
    except InterruptError as interrupt:
        typer.echo("stopped at once", err=True)
        raise typer.Exit(EXIT_SIGNAL + interrupt.number) from None
    except UsageError as error:
        said: Any = error
        text = said.format_message().strip()
        if not text or "\n" in text:  # help, which was asked for by typing nothing; it may be printed already
            raise
        command = f"; see {said.ctx.command_path} --help" if said.ctx is not None else ""
        typer.echo(f"error: {one_line(text).rstrip('.')}{command}", err=True)
        raise typer.Exit(said.exit_code) from None


@contextmanager
def traceback_in(directory: Path | None = None) -> Iterator[None]:
    """Turn an unexpected error of the block into one line that names a file with its traceback.

    Args:
        directory: of the run that the block is about; None, or where nothing can be written there: that for temporary
            files.

    Raises:
        UnexpectedError: it happened.
        NoRoomError: no memory, or a full disk.
        TandemError: a path that cannot be used; or whatever the block raised.
    """
    try:
        yield
    except (TandemError, UsageError, typer.Exit, typer.Abort, BrokenPipeError):  # typer ends where no reader is left
        raise
    except Exception as error:
        raise _explained(error, directory) from error


def _explained(error: Exception, directory: Path | None) -> TandemError:
    said = one_line(str(error), 300)
    if isinstance(error, OSError):
        file = os.fsdecode(error.filename) if error.filename is not None else None
        if error.errno in _PATH_ERRORS and file is not None:
            return TandemError(f"cannot use {file}: {error.strerror}; check the path and its permissions")
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            where = file or "what is printed"
            return NoRoomError(f"cannot write {where}: {error.strerror}; free some space and try again")
    if isinstance(error, MemoryError) or re.search(r"allocate memory|out of memory", said):  # NumPy, torch
        return NoRoomError(
            f"not enough memory: {said or 'none is left'}; ask for less, such as fewer worlds (game.num_worlds) or "
            "smaller networks, or take a machine with more"
        )
    what = f"unexpected {type(error).__name__}{': ' if said else ''}{said}"
    for place in ([directory] if directory is not None and directory.is_dir() else []) + [Path(tempfile.gettempdir())]:
        with suppress(OSError):
            return UnexpectedError(f"{what}; its traceback is in {_write_traceback(error, place)}, please report it")
    return UnexpectedError(f"{what}; its traceback cannot be written anywhere; please report it")


def _write_traceback(error: Exception, directory: Path) -> str:
    """Make a file of its own, which only this user may read: a traceback may quote what is private."""
    stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
    head = f"tandem {__version__}, Python {platform.python_version()}, {platform.platform()}\n{sys.argv}\n\n"
    descriptor, path = tempfile.mkstemp(".txt", f"{TRACEBACK_PREFIX}{stamp}-", directory)
    with open(descriptor, "w", encoding="utf-8", errors="backslashreplace") as file:
        file.write(head + "".join(traceback.format_exception(error)))
    return path


def how_to_go_on(run_dir: Path, registry: Path | str, typed: Sequence[str] = ()) -> str:
    """The command that continues a run or a study, with the options that were ``typed`` and no file keeps."""
    command = ["tandem", "train", "--resume", "--run-dir", str(run_dir), "--registry", str(registry), *typed]
    return f"continue with: {shlex.join(command)}"


def stopped(what: str, number: int, hint: str, *, begun: bool = True) -> typer.Exit:
    """Say how to go on with what a signal ended; returns the exit of a process that a signal ends."""
    typer.echo(f"{what}; {hint if begun else 'nothing was saved yet'}")
    return typer.Exit(EXIT_SIGNAL + number)


def print_json(tree: Any) -> None:
    """Print a tree of plain values."""
    typer.echo(json.dumps(tree, indent=1))


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table on a terminal, and lines of cells with tabs between elsewhere; what files hold moves no cursor."""
    rows = [[one_line(cell, MAX_CELL) for cell in row] for row in rows]
    if not sys.stdout.isatty():
        for row in (header, *rows):
            typer.echo("\t".join(row))
        return
    from rich.markup import escape
    from rich.table import Column, Table

    table = Table(Column(header[0], no_wrap=True), *header[1:])  # what is typed again must stay in one piece
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    Console().print(table)
