"""One process at a time in a directory.

A lock keeps others out, and the kernel frees it when its holder dies, however that happens. But where a network file
system has none, or has given it away while its holder was cut off, a file system cannot refuse what a stale process
writes. So each process that ever ran a run has a number, its epoch, of which only the highest may write. A number is
claimed by making a file that must not be there yet. It is part of the names of checkpoints and of the status, and
readers take the highest.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import socket
import time
from io import FileIO
from pathlib import Path
from typing import BinaryIO

from service.base.errors import RunTakenError, TandemError
from service.base.files import open_regular, open_to_append, os_errors, read_regular
from service.base.parsing import parse_json

LOCK_FILE = ".lock"
EPOCHS = "epochs"
"""Directory of a file for each number that was claimed."""
WITHOUT_LOCKS = "TANDEM_WITHOUT_LOCKS"
"""Variable of the environment that says, with 1, that the user sees to it that one process uses a directory."""
WAIT_S = 0.5
"""Longer than ``is_locked`` of another process keeps the lock to itself."""
_logger = logging.getLogger(__name__)


class DirectoryLock:
    """An exclusive hold on a directory, from construction until `release` or until this process dies.

    Args:
        directory: made when missing.

    Raises:
        RunTakenError: another process, or another object in this one, has the lock; or the file system has no locks,
            and ``TANDEM_WITHOUT_LOCKS`` does not say that this is known.
        StorageError: the directory cannot be written.
    """

    def __init__(self, directory: Path) -> None:
        self._path = path = directory / LOCK_FILE
        with os_errors("write", path):
            directory.mkdir(parents=True, exist_ok=True)
            self._file = open_to_append(path)
        try:
            taken = take(self._file, path, WAIT_S)
        except OSError as error:
            self._file.close()
            raise RunTakenError(
                f"{path}: its file system has no locks ({error.strerror}), so nothing keeps a second process out; use "
                f"another directory, or see to it that there is only one and set {WITHOUT_LOCKS}=1"
            ) from None
        if not taken:
            self._file.close()
            found = holder(directory)
            who = "another process" if found is None else f"process {found[1]} on {found[0]}"
            raise RunTakenError(f"{directory} is in use by {who}; stop that one first, or name another --run-dir")
        note = {"pid": os.getpid(), "host": socket.gethostname()}
        with contextlib.suppress(OSError):  # a full disk: who has it is only told to people
            self._file.truncate(0)
            self._file.write(json.dumps(note).encode())

    def release(self, *, begun: bool = True) -> None:
        """Let others in.

        Args:
            begun: whether anything has begun in the directory; else it goes, if nothing else is in it.
        """
        if not begun:
            with contextlib.suppress(OSError):
                self._path.unlink()
                self._path.parent.rmdir()
        self._file.close()


def take(file: FileIO, path: Path, wait_s: float) -> bool:
    """Take the exclusive lock of an open file, until it is closed; whether that went within ``wait_s``.

    Raises:
        OSError: its file system has no locks, and ``TANDEM_WITHOUT_LOCKS`` does not say that this is known.
    """
    try:
        return _take(file, fcntl.LOCK_EX, wait_s)
    except OSError as error:
        if os.environ.get(WITHOUT_LOCKS) != "1":
            raise
        _logger.warning("%s: no locks there (%s), as %s says", path, error.strerror, WITHOUT_LOCKS)
        return True


def is_locked(directory: Path) -> bool:
    """Whether some process holds the directory's lock now."""
    try:
        with open_regular(directory / LOCK_FILE) as file:
            return not _take(file, fcntl.LOCK_SH, 0.0)
    except OSError:  # it was never locked, or cannot be
        return False


def holder(directory: Path) -> tuple[str, int] | None:
    """Host and process that last took the directory's lock, as it noted them; None where that cannot be read."""
    with contextlib.suppress(OSError, TandemError, ValueError, KeyError, TypeError):
        note = parse_json(read_regular(directory / LOCK_FILE, 1000), "the lock")
        return str(note["host"])[:100], int(note["pid"])
    return None


def _take(file: FileIO | BinaryIO, kind: int, wait_s: float) -> bool:
    deadline_s = time.monotonic() + wait_s
    while True:
        try:
            fcntl.flock(file, kind | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.monotonic() >= deadline_s:
                return False
            time.sleep(0.02)


def claim_epoch(directory: Path) -> int:
    """Claim the next number of a run directory: one above all others.

    Raises:
        StorageError: it cannot be claimed.
    """
    numbers = directory / EPOCHS
    while True:
        with os_errors("write", numbers):
            numbers.mkdir(parents=True, exist_ok=True)
            number = _newest(numbers) + 1
        path = _epoch_file(directory, number)
        with os_errors("write", path), contextlib.suppress(FileExistsError):  # another process was quicker
            path.touch(exist_ok=False)
            return number


def give_back_epoch(directory: Path, number: int) -> None:
    """Let a number go, of a run that did not begin."""
    with contextlib.suppress(OSError):
        _epoch_file(directory, number).unlink()
        (directory / EPOCHS).rmdir()


def newest_epoch(directory: Path) -> int:
    """The highest number that was claimed in a run directory; 0 where there is none."""
    try:
        return _newest(directory / EPOCHS)
    except OSError:
        return 0


def _newest(numbers: Path) -> int:
    return max((int(name) for name in os.listdir(numbers) if name.isdecimal()), default=0)


def _epoch_file(directory: Path, number: int) -> Path:
    return directory / EPOCHS / f"{number:08d}"
