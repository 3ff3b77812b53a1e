"""The records of a run: files of one JSON object per line, appended as the run goes and cut back when it resumes.

A killed run leaves at most one torn line, at the end: readers pass over it and `JsonlWriter.truncate_after`
drops it. A full disk leaves none.
"""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from service.io.errors import StorageError
from service.io.files import Appender, os_errors, write_atomic
from service.parsing import ParseError, parse_json
from service.regular_files import read_regular

MAX_BYTES = 8 * 1024**3
"""Of a run's records; a million iterations have some two gigabytes."""


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


@dataclass(frozen=True, slots=True)
class Damage:
    """What is wrong with a file of records."""

    path: Path
    lost: tuple[int, ...]
    """Iterations whose record is missing, or not as it was written."""
    num_foreign: int
    """Lines among the others that nobody wrote."""

    def __str__(self) -> str:
        return f"{self.path}: {self.text}"

    @property
    def text(self) -> str:
        """The damage in words, without the file."""
        many = "the records of iterations" if len(self.lost) > 1 else "the record of iteration"
        be = "are" if len(self.lost) > 1 else "is"
        parts = [f"{many} {_ranges(self.lost)} {be} missing or changed"] if self.lost else []
        parts += [f"{self.num_foreign} lines are not the run's"] if self.num_foreign else []
        return " and ".join(parts) or "its lines are in another order"


class JsonlWriter(Appender):
    """Appends records to one file, a line each, so that a kill loses no record already written."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._written: list[tuple[int, int]] = []

    def checksums(self) -> str:
        """The iteration and CRC-32 of every line that was written, or kept by ``truncate_after``; for a checkpoint.

        Later, ``damage`` and ``keep_only`` compare the file with it. Base64, as JSON would be three times as long.
        """
        return base64.b64encode(np.array(self._written, dtype="<i8").tobytes()).decode()

    def damage(self, checksums: str) -> Damage | None:
        """Find what is not as ``checksums`` once said of the file's first lines; None where all is.

        Raises:
            StorageError: the file cannot be read.
        """
        rows = _decode(checksums)
        found = [(iteration, crc) for iteration, crc, _ in self._found()]
        if found[: len(rows)] == rows:
            return None
        there = set(found)
        lost = [iteration for iteration, crc in rows if (iteration, crc) not in there]
        known = set(rows)
        unknown = sum(row not in known for row in found[: len(rows)])
        return Damage(self.path, tuple(lost), max(0, unknown - len(lost)))  # of a lost one, what it was changed to

    def keep_only(self, checksums: str) -> None:
        """Drop every line that ``checksums`` did not know, in one atomic step.

        Raises:
            StorageError: the file cannot be read or written.
        """
        known = set(_decode(checksums))
        kept = {(iteration, crc): line for iteration, crc, line in self._found() if (iteration, crc) in known}
        self.take_new_file()
        with os_errors("write", self.path):
            write_atomic(self.path, b"".join(line + b"\n" for line in kept.values()))

    def _found(self) -> Iterator[tuple[int, int, bytes]]:
        """Iteration, or -1, checksum and text of every whole line, whatever it holds."""
        if not self.path.exists():
            return
        with os_errors("read", self.path):
            *lines, _ = read_regular(self.path, MAX_BYTES).split(b"\n")
        for line in lines:
            record = _parse(line) or {}
            iteration = record.get("iteration")
            number = iteration if isinstance(iteration, int) and abs(iteration) < 2**63 else -1
            yield number, zlib.crc32(line), line

    def append(self, record: Mapping[str, Any]) -> None:
        """Write ``record``, made `plain`, as the file's last line and hand it to the operating system.

        Raises:
            StorageError: the disk is full or the file cannot be written; the record waits, see `append_bytes`.
        """
        line = json.dumps(plain(record), allow_nan=False).encode()
        self._written.append((int(record.get("iteration", -1)), zlib.crc32(line)))
        self.append_bytes(line + b"\n")

    def truncate_after(self, iteration: int) -> None:
        """Drop the records whose ``iteration`` is above the given one, and a torn last line, in one atomic step.

        The lines kept keep their bytes, so a resumed run's file equals an uninterrupted one's. A missing file is empty.

        Raises:
            StorageError: a line is damaged or lacks ``iteration``, or the file cannot be written; it is then as it was.
        """
        if not self.path.exists():
            return
        numbered = [(_iteration(record, self.path), line) for line, record in _lines(self.path)]
        lines = [(number, line) for number, line in numbered if number <= iteration]
        self._written = [(number, zlib.crc32(line)) for number, line in lines]
        kept = b"".join(line + b"\n" for _, line in lines)
        same = kept == read_regular(self.path, MAX_BYTES)
        self.take_new_file()
        try:
            with os_errors("write", self.path):
                write_atomic(self.path, kept)  # also the same bytes: see Appender
        except StorageError:
            if not same:  # else a disk that is full need not be written to
                raise


def _lines(path: Path) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """Each line of ``path`` without its line end, and the record in it."""
    with os_errors("read", path):
        *whole, tail = read_regular(path, MAX_BYTES).split(b"\n")
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
        record = parse_json(line, "a line", allow_nan=True)
    except ParseError:
        return None
    return record if isinstance(record, dict) else None


def _iteration(record: Mapping[str, Any], path: Path) -> int:
    iteration = record.get("iteration")
    if not isinstance(iteration, int) or abs(iteration) >= 2**63:
        raise StorageError(
            f"{path}: a record has iteration {iteration!r}, not a whole number; remove that line and try again"
        )
    return iteration


def _ranges(numbers: tuple[int, ...]) -> str:
    """Numbers in words, neighbours together: 3-5, 9."""
    runs = [list(run) for _, run in groupby(enumerate(sorted(numbers)), lambda pair: pair[1] - pair[0])]
    return ", ".join(f"{run[0][1]}-{run[-1][1]}" if len(run) > 1 else str(run[0][1]) for run in runs)


def _decode(checksums: str) -> list[tuple[int, int]]:
    pairs = np.frombuffer(base64.b64decode(checksums), dtype="<i8").reshape(-1, 2)
    return [(iteration, crc) for iteration, crc in pairs.tolist()]
