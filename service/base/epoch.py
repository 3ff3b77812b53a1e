"""Epochs of a run: the number of each process that ever ran it, of which only the highest may write.

A lock keeps others out of a directory. But where a network file system has none, or has given it away while its holder
was cut off, a file system cannot refuse what a stale process writes. So numbers are claimed by making a file that must
not be there yet, they are part of the names of checkpoints and of the status, and readers take the highest.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from service.base.files import os_errors

DIRECTORY = "epochs"


def claim_epoch(directory: Path) -> int:
    """Claim the next number of a run directory: one above all others.

    Raises:
        StorageError: it cannot be claimed.
    """
    while True:
        number = newest_epoch(directory) + 1
        path = _path(directory, number)
        with os_errors("write", path):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                path.touch(exist_ok=False)
            except FileExistsError:  # another process was quicker
                continue
        return number


def give_back_epoch(directory: Path, number: int) -> None:
    """Let a number go, of a run that did not begin."""
    with contextlib.suppress(OSError):
        _path(directory, number).unlink()
        (directory / DIRECTORY).rmdir()


def newest_epoch(directory: Path) -> int:
    """The highest number that was claimed in a run directory; 0 where there is none."""
    try:
        names = os.listdir(directory / DIRECTORY)
    except OSError:
        return 0
    return max((int(name) for name in names if len(name) >= 8 and name.isdecimal()), default=0)


def _path(directory: Path, number: int) -> Path:
    return directory / DIRECTORY / f"{number:08d}"
