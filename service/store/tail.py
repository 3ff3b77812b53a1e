"""A growing file of records: its newest ones, a sample, and columns, for which only new lines are read."""

from __future__ import annotations

import logging
import math
import sys
from array import array
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from threading import RLock
from typing import BinaryIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.base.files import open_regular
from service.base.parsing import ParseError, parse_json, parse_with
from service.store.models import Columns, Record

INDEX = ("iteration", "env_steps")
"""Keys of every record that are no metrics."""
MAX_ITERATION = 2**53
_SEAL_BYTES = 256
"""Length of the end of what was read, by which a file is known again that was cut meanwhile."""
_MAX_LINE_BYTES = 1024 * 1024
_TAIL_BYTES = 32 * 1024
_parse = msgspec.json.Decoder(dict[str, int | float | None]).decode
"""Parses a line ten times as fast as the ``json`` of Python, which reads what this one refuses."""
_logger = logging.getLogger(__name__)


class Table(dict[str, "array[float]"]):
    """Records as a column for each key, which takes a tenth of their memory; NaN where a record has nothing.

    An iteration that comes again cuts off all after it. A column ends with the last record that has its key.
    """

    def add(self, record: Record) -> None:
        """Append one record."""
        iterations = self.setdefault("iteration", array("d"))
        if iterations and _iteration(record) <= iterations[-1]:
            size = bisect_left(iterations, _iteration(record))
            for column in self.values():
                del column[size:]
        size = len(iterations)
        for name, value in record.items():
            if name not in self:
                self[name] = array("d")
            column = self[name]
            if len(column) < size:
                column.extend([math.nan] * (size - len(column)))
            column.append(math.nan if value is None else value)

    def columns(self, names: Sequence[str] | None) -> Columns:
        """Metrics over all iterations; None for all that there are. Names that no record has are left out."""
        there = sorted(self.keys() - set(INDEX))
        wanted = there if names is None else [name for name in names if name in there]
        iterations, env_steps = map(self._whole, INDEX)
        return Columns(
            iteration=iterations.astype(np.int64),
            env_steps=np.nan_to_num(env_steps).astype(np.int64),
            metrics={name: self._whole(name) for name in wanted},
            names=tuple(there),
        )

    def _whole(self, name: str) -> NDArray[np.float64]:
        whole = np.full(len(self.get("iteration", ())), np.nan)
        column = self.get(name, ())
        whole[: len(column)] = column
        return whole


class RecordFile:
    """The iterations of one ``metrics.jsonl``; any number of threads may read at once. A missing file is empty.

    A resumed run cuts the file and goes on: where an iteration comes again, it and all after it are made anew.
    Columns stay in memory until ``forget``. Every method raises ``OSError`` where the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, RLock()
        self.forget()

    def forget(self) -> None:
        """Free the memory of all columns."""
        with self._lock:
            self._table = Table()
            self._end, self._seal = 0, b""
            self.num_bytes = 0
            """Memory that the columns take."""
            self.num_passed_over = 0
            """Lines that are no records, of those in columns."""

    def after(self, iteration: int, most: int | None = None) -> list[Record]:
        """The records of iterations above ``iteration``, in order; at most ``most``, the first ones."""
        with self._open() as file:
            kept = _newest(file)
            if not kept or _iteration(kept[0]) > iteration:
                kept = _read_from(file, 0, iteration, most)
        return [record for record in kept if _iteration(record) > iteration][:most]

    def newest(self) -> Record | None:
        """The last record."""
        with self._open() as file:
            kept = _newest(file)
        return kept[-1] if kept else None

    def sample(self, name: str, number: int) -> list[float | None]:
        """A metric of about ``number`` records, evenly over the file and with the last, without reading the others."""
        found: dict[int, Record] = {}
        with self._open() as file:
            size = file.seek(0, 2)
            for start in [size * index // number for index in range(number)]:
                file.seek(max(0, start - 1))
                if start:
                    file.readline(_MAX_LINE_BYTES)  # the rest of a line
                if (record := parse_record(file.readline(_MAX_LINE_BYTES))) is not None:
                    found[_iteration(record)] = record
            for last in _newest(file)[-1:]:
                found[_iteration(last)] = last
        return [record.get(name) for record in found.values()]

    def columns(self, names: Sequence[str] | None) -> Columns:
        """Metrics over all iterations; see ``Table.columns``."""
        with self._lock, self._open() as file:
            file.seek(self._end - len(self._seal))
            if file.read(len(self._seal)) != self._seal:  # cut by a resume, or another file
                self.forget()
                file.seek(0)
            for line in _lines(file):  # a torn last one waits for its end
                if (record := parse_record(line)) is not None:
                    self._table.add(record)
                else:
                    self.num_passed_over += 1
                    _logger.warning("%s: passing over what is no record: %r", self._path, line[:60])
                self._end += len(line)
                self._seal = line[-_SEAL_BYTES:]
            self.num_bytes = sum(8 * len(column) for column in self._table.values())
            return self._table.columns(names)

    def _open(self) -> BinaryIO:
        try:
            return open_regular(self._path)
        except FileNotFoundError:
            return BytesIO()


def parse_record(text: bytes) -> Record | None:
    """One record of JSON text; None where it is none. What is no number is left out; no finite one is None."""
    try:
        record = parse_with(_parse, text, "record")
    except ParseError:  # NaN, which is no JSON, or something that is no number
        record = None
        with suppress(ParseError):
            record = parse_json(text, "record", allow_nan=True)
    if not isinstance(record, dict):
        return None
    iteration = record.get("iteration")
    if type(iteration) is not int or abs(iteration) > MAX_ITERATION:
        return None
    return {
        name: value if value is None or abs(value) <= sys.float_info.max else None
        for name, value in record.items()
        if value is None or type(value) in (int, float)
    }


def _iteration(record: Record) -> int:
    return int(record["iteration"] or 0)


def _lines(file: BinaryIO) -> Iterator[bytes]:
    """Whole lines from here on. One that is too long is no record, nor is what follows it."""
    while (line := file.readline(_MAX_LINE_BYTES)).endswith(b"\n"):
        yield line


def _newest(file: BinaryIO) -> list[Record]:
    """The newest records, the last three at least, if there are as many."""
    end, size = file.seek(0, 2), _TAIL_BYTES
    while len(kept := _read_from(file, max(0, end - size))) < 3 and size < end:
        size *= 4
    return kept


def _read_from(file: BinaryIO, start: int, after: int = -1, most: int | None = None) -> list[Record]:
    """The records behind a place in a file, each iteration once: those above ``after``, at most ``most``."""
    file.seek(start)
    if start:
        file.readline(_MAX_LINE_BYTES)  # the rest of a line
    kept: list[Record] = []
    for record in filter(None, map(parse_record, _lines(file))):
        while kept and _iteration(kept[-1]) >= _iteration(record):
            kept.pop()
        if _iteration(record) > after:
            kept.append(record)
        if len(kept) == most:
            break
    return kept
