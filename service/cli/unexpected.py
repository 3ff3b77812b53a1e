"""Unexpected errors: one line for the user, and the traceback in a file for a developer."""

from __future__ import annotations

import errno
import os
import platform
import re
import secrets
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import typer

from service.base.errors import TRACEBACK_PREFIX, NoRoomError, TandemError, UnexpectedError, one_line
from service.base.version import __version__

UsageError: type[Exception] = typer.BadParameter.__bases__[0]
"""The error of arguments that typer cannot read; it has no public name in all versions of typer."""
_PATH_ERRORS = (errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR)
"""Reasons for which a path that was typed cannot be used."""


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
    except (TandemError, UsageError, typer.Exit, typer.Abort):
        raise
    except OSError as error:
        if error.errno == errno.EPIPE:  # the reader of our output is gone, which typer knows how to end
            raise
        if error.errno in _PATH_ERRORS and error.filename is not None:
            raise TandemError(
                f"cannot use {os.fsdecode(error.filename)}: {error.strerror}; check the path and its permissions"
            ) from error
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            where = os.fsdecode(error.filename) if error.filename is not None else "what is printed"
            raise NoRoomError(f"cannot write {where}: {error.strerror}; free some space and try again") from error
        raise _unexpected(error, directory) from error
    except Exception as error:
        if isinstance(error, MemoryError) or re.search(r"allocate memory|out of memory", str(error)):  # NumPy, torch
            raise NoRoomError(
                f"not enough memory: {one_line(str(error), 300) or 'none is left'}; ask for less, such as fewer worlds "
                "(game.num_worlds) or smaller networks, or take a machine with more"
            ) from error
        raise _unexpected(error, directory) from error


def _unexpected(error: BaseException, directory: Path | None) -> UnexpectedError:
    said = one_line(str(error), 300)
    what = f"unexpected {type(error).__name__}{': ' if said else ''}{said}"
    for place in ([directory] if directory is not None and directory.is_dir() else []) + [Path(tempfile.gettempdir())]:
        with suppress(OSError):
            return UnexpectedError(f"{what}; its traceback is in {_write_traceback(error, place)}, please report it")
    return UnexpectedError(f"{what}; its traceback cannot be written anywhere; please report it")


def _write_traceback(error: BaseException, directory: Path) -> Path:
    """Make a file of its own, which only this user may read: a traceback may quote what is private."""
    stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
    path = directory / f"{TRACEBACK_PREFIX}{stamp}-{secrets.token_hex(4)}.txt"
    head = f"tandem {__version__}, Python {platform.python_version()}, {platform.platform()}\n{sys.argv}\n\n"
    text = head + "".join(traceback.format_exception(error))
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    with open(descriptor, "w", encoding="utf-8", errors="backslashreplace") as file:
        file.write(text)
    return path
