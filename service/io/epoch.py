"""Epochs of a run: the number of each process that ever ran it, of which only the highest may write.

A lock keeps others out of a directory. But where a network file system has none, or has given it away while its holder
was cut off, a file system cannot refuse what a stale process writes. So numbers are claimed by making a file that must
not be there yet, they are part of the names of checkpoints and of the status, and readers take the highest.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
from datetime import UTC, datetime
from pathlib import Path

from service.io.errors import RunTakenError
from service.io.files import os_errors

DIRECTORY = "epochs"
NUM_KEPT = 10


class Epoch:
    """The number that this process claims for itself in a run directory: one above all others.

    Args:
        directory: of the run.

    Raises:
        StorageError: it cannot be claimed.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        path = directory / DIRECTORY
        note = {"host": socket.gethostname(), "pid": os.getpid(), "since": datetime.now(UTC).isoformat()}
        with os_errors("write", path):
            path.mkdir(parents=True, exist_ok=True)
            while True:
                self.number = newest_epoch(directory) + 1
                try:
                    descriptor = os.open(path / f"{self.number:08d}", os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
                except FileExistsError:  # another process was quicker
                    continue
                if newest_epoch(directory) == self.number:
                    break
                os.close(descriptor)  # several were, and this number may have been claimed and deleted before
            with contextlib.suppress(OSError):  # a full disk: who it is is only told to people
                os.write(descriptor, json.dumps(note).encode())
            os.close(descriptor)
            for number in _numbers(directory)[:-NUM_KEPT]:
                (path / f"{number:08d}").unlink(missing_ok=True)

    def give_back(self) -> None:
        """Let the number go, of a run that did not begin."""
        with contextlib.suppress(OSError):
            path = self._directory / DIRECTORY
            (path / f"{self.number:08d}").unlink()
            path.rmdir()

    def check(self) -> None:
        """Assert that no other process has a higher number.

        Raises:
            RunTakenError: one has; this one must write nothing more.
        """
        if newest_epoch(self._directory) > self.number:
            raise RunTakenError(
                f"{self._directory} was taken over by another process; this one stops, and what it did since then is "
                "not kept"
            )


def newest_epoch(directory: Path) -> int:
    """The highest number that was claimed in a run directory; 0 where there is none."""
    return max(_numbers(directory), default=0)


def _numbers(directory: Path) -> list[int]:
    try:
        names = os.listdir(directory / DIRECTORY)
    except OSError:
        return []
    return sorted(int(name) for name in names if len(name) >= 8 and name.isdecimal())
