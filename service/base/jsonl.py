"""The records of a run: files of one JSON object per line, appended as the run goes and cut back when it resumes.

A killed run leaves at most one torn line, at the end: readers pass over it. A full disk leaves none.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from service.base.errors import StorageError
from service.base.files import Appender, open_regular, os_errors, read_regular, write_atomic
from service.base.parsing import ParseError, parse_json

MAX_LINE_BYTES = 64 * 1024 * 1024
"""Of a record in memory; of a line that is longer nothing is kept."""


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
    with os_errors("read", path):
        *lines, tail = read_regular(path).split(b"\n")
    records = []
    for number, line in enumerate(lines, start=1):
        record = _parse(line)
        if record is None:
            raise StorageError(
                f"{path} line {number}: {line[:40]!r} is not a JSON object; remove that line and try again"
            )
        records.append(record)
    last = _parse(tail)
    return [*records, last] if last is not None else records


class JsonlWriter(Appender):
    """Appends records to one file, a line each, so that a kill loses no record already written."""

    def append(self, record: Mapping[str, Any]) -> None:
        """Write ``record``, made `plain`, as the file's last line and hand it to the operating system.

        Raises:
            StorageError: the disk is full or the file cannot be written; the record waits, see `append_bytes`.
        """
        self.append_bytes(json.dumps(plain(record), allow_nan=False).encode() + b"\n")

    def cut_after(self, iteration: int) -> tuple[int, int]:
        """Keep the records up to an iteration, in one atomic step; lines that are no records in their order go.

        Returns:
            Number of records that are kept, and of lines that were none.

        Raises:
            StorageError: the file cannot be read or written; it is then as it was.
        """
        num_kept, num_strange = 0, 0

        def kept(file: BinaryIO) -> Iterator[bytes]:
            nonlocal num_kept, num_strange
            newest = -1
            for line in _lines(file, self.path):
                number = (_parse(line) or {}).get("iteration")
                if not isinstance(number, int) or not newest < number < 2**63:
                    num_strange += 1
                elif number <= iteration:
                    newest = number
                    num_kept += 1
                    yield line

        with os_errors("read", self.path):
            try:
                file = open_regular(self.path)
            except FileNotFoundError:
                return 0, 0
        with file:
            self.take_new_file()
            write_atomic(self.path, kept(file))  # also the same bytes: see Appender
        return num_kept, num_strange


def _lines(file: BinaryIO, path: Path) -> Iterator[bytes]:
    """Lines with their ends, one at a time, without a torn last one."""
    with os_errors("read", path):
        pieces = iter(partial(file.readline, MAX_LINE_BYTES), b"")
        yield from (piece for piece in pieces if piece.endswith(b"\n"))


def _parse(line: bytes) -> dict[str, Any] | None:
    try:
        record = parse_json(line, "a line", allow_nan=True)
    except ParseError:
        return None
    return record if isinstance(record, dict) else None
