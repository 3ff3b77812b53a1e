"""Files that grow by whole pieces: a full disk leaves no torn piece, and none is lost while the process lives."""

from __future__ import annotations

import contextlib
import os
from collections import deque
from io import FileIO
from pathlib import Path

from service.io.files import os_errors


class Appender:
    """Appends pieces to one file; a piece that does not fit waits, and comes before the next one.

    Args:
        path: the file; what is there already stays, and nothing is made before the first piece.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._waiting: deque[bytes] = deque()

    def append_bytes(self, piece: bytes) -> None:
        """Put ``piece`` at the file's end and hand it to the operating system.

        Raises:
            StorageError: the disk is full or the file cannot be written; the file ends with a whole piece, and
                ``piece`` waits for the next call or `sync`.
        """
        self._waiting.append(piece)
        self._flush()

    def sync(self) -> None:
        """Write what waits, and wait until the disk has it.

        Raises:
            StorageError: as for `append_bytes`.
        """
        self._flush()
        if self.path.exists():
            with os_errors("write", self.path), self.path.open("rb") as file:
                os.fsync(file.fileno())

    def _flush(self) -> None:
        if not self._waiting:
            return
        with os_errors("write", self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab", buffering=0) as file:
                while self._waiting:
                    _write_whole(file, self._waiting[0])
                    self._waiting.popleft()


def _write_whole(file: FileIO, piece: bytes) -> None:
    end = file.seek(0, os.SEEK_END)
    try:
        view = memoryview(piece)
        while view:
            view = view[file.write(view) :]
    except BaseException:  # a signal's, too
        with contextlib.suppress(OSError):  # the first error is the one the user has to know
            file.truncate(end)
        raise
