"""The records of a run: files of one JSON object per line, appended as the run goes and cut back when it resumes.

A killed run leaves at most one torn line, at the end: readers pass over it and `JsonlWriter.truncate_after`
drops it. A full disk leaves none.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from service.io.errors import StorageError
from service.io.files import Appender, os_errors, write_atomic


def plain(value: Any) -> Any:
    """``value`` in JSON's own types: NumPy's become plain ones; NaN and infinity, which JSON lacks, become null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_jsonl(path: Path) -> list[dict[str, Any]]:
    """The records of ``path`` in their order; a torn last line (no line end, not JSON) is passed over.

    Raises:
        StorageError: the file is missing or unreadable, or a line other than a torn last one is no JSON object.
    """
    return [record for _, record in _lines(path)]


class JsonlWriter(Appender):
    """Appends records to one file, a line each, so that a kill loses no record already written."""

    def append(self, record: Mapping[str, Any]) -> None:
        """Write ``record``, made `plain`, as the file's last line and hand it to the operating system.

        Raises:
            StorageError: the disk is full or the file cannot be written; the record waits, see `append_bytes`.
        """
        line = json.dumps(plain(record), allow_nan=False) + "\n"
        self.append_bytes(line.encode())

    def truncate_after(self, iteration: int) -> None:
        """Drop the records whose ``iteration`` is above the given one, and a torn last line, in one atomic step.

        The lines kept keep their bytes, so a resumed run's file equals an uninterrupted one's. A missing file is empty.

        Raises:
            StorageError: a line is damaged or lacks ``iteration``, or the file cannot be written; it is then as it was.
        """
        if not self.path.exists():
            return
        lines = [line for line, record in _lines(self.path) if _iteration(record, self.path) <= iteration]
        kept = b"".join(line + b"\n" for line in lines)
        if kept == self.path.read_bytes():
            return  # a disk that is full need not be written to
        with os_errors("write", self.path):
            write_atomic(self.path, kept)


def _lines(path: Path) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """Each line of ``path`` without its line end, and the record in it."""
    with os_errors("read", path):
        *whole, tail = path.read_bytes().split(b"\n")
    for number, line in enumerate(whole, start=1):
        record = _parse(line)
        if record is None:
            raise StorageError(
                f"{path} line {number}: {line[:40]!r} is not a JSON object; remove that line and try again"
            )
        yield line, record
    last = _parse(tail)
    if last is not None:
        yield tail, last


def _parse(line: bytes) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
    except ValueError:  # also what bytes that are no UTF-8 raise
        return None
    return record if isinstance(record, dict) else None


def _iteration(record: Mapping[str, Any], path: Path) -> int:
    iteration = record.get("iteration")
    if not isinstance(iteration, int):
        raise StorageError(
            f"{path}: a record has iteration {iteration!r}, not a whole number; remove that line and try again"
        )
    return iteration
