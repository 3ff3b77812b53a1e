"""A growing file of records, read again and again: only new lines are parsed, and only their places are kept."""

from __future__ import annotations

import logging
import math
from bisect import bisect_left, bisect_right
from pathlib import Path
from threading import Lock
from typing import BinaryIO

from service.parsing import ParseError, parse_json
from service.regular_files import open_regular
from service.store.models import Record

_SEAL_BYTES = 256
_MAX_LINE_BYTES = 1024 * 1024
_logger = logging.getLogger(__name__)


class RecordFile:
    """The iterations of one ``metrics.jsonl``; any number of threads may read at once. A missing file is empty.

    A resumed run cuts the file and goes on: where an iteration comes again, it and all after it are made anew.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = Lock()
        self._forget()

    def after(self, iteration: int) -> list[Record]:
        """The records of iterations above ``iteration``, in order.

        Raises:
            OSError: the file cannot be read.
        """
        with self._lock, self._open() as file:
            self._catch_up(file)
            first = bisect_right(self._iterations, iteration)
            return [self._read(file, *span) for span in self._spans[first:]]

    def last(self) -> Record | None:
        """The newest record; None before the first.

        Raises:
            OSError: the file cannot be read.
        """
        with self._lock, self._open() as file:
            self._catch_up(file)
            return self._read(file, *self._spans[-1]) if self._spans else None

    def _open(self) -> BinaryIO:
        try:
            return open_regular(self._path)
        except FileNotFoundError:
            return open("/dev/null", "rb")

    def _forget(self) -> None:
        self._iterations: list[int] = []
        self._spans: list[tuple[int, int]] = []
        self._end, self._seal = 0, b""

    def _catch_up(self, file: BinaryIO) -> None:
        """Find the lines that are new; a torn last one waits for its end."""
        file.seek(self._end - len(self._seal))
        if file.read(len(self._seal)) != self._seal:  # cut by a resume, or another file
            self._forget()
            file.seek(0)
        # a line that is longer is no record, nor is what follows it
        while (line := file.readline(_MAX_LINE_BYTES)).endswith(b"\n"):
            self._take(line)
            self._end += len(line)
            self._seal = line[-_SEAL_BYTES:]

    def _take(self, line: bytes) -> None:
        record = parse_record(line)
        if record is None:
            _logger.warning("%s: passing over what is no record: %r", self._path, line[:60])
            return
        iteration = int(record["iteration"] or 0)
        again = bisect_left(self._iterations, iteration)
        del self._iterations[again:], self._spans[again:]
        self._iterations.append(iteration)
        self._spans.append((self._end, len(line)))

    def _read(self, file: BinaryIO, start: int, size: int) -> Record:
        file.seek(start)
        record = parse_record(file.read(size))
        assert record is not None
        return record


def parse_record(text: bytes) -> Record | None:
    """One record of JSON text; None where it is none."""
    try:
        record = parse_json(text, "record", allow_nan=True)
    except ParseError:
        return None
    if not isinstance(record, dict) or type(record.get("iteration")) is not int:
        return None
    values = {name: value for name, value in record.items() if value is None or type(value) in (int, float)}
    return {name: None if value is not None and not math.isfinite(value) else value for name, value in values.items()}
