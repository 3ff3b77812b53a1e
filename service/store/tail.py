"""A growing file of records: its newest ones, a sample, and columns, for which only new lines are read."""

from __future__ import annotations

import logging
import math
import sys
from array import array
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from io import BytesIO
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from service.base.parsing import ParseError, parse_json, parse_with
from service.base.regular_files import open_regular
from service.store.models import Columns, Record

INDEX = ("iteration", "env_steps")
"""Keys of every record that are no metrics."""
MAX_ITERATION = 2**53
_SEAL_BYTES = 256
"""Length of the end of what was read, by which a file is known again that was cut meanwhile."""
_MAX_LINE_BYTES = 1024 * 1024
_TAIL_BYTES = 32 * 1024
_BATCH = 1000
"""Lines that are decoded before they become numbers of NumPy's, which need a tenth of the room."""
_logger = logging.getLogger(__name__)


class RecordFile:
    """The iterations of one ``metrics.jsonl``; any number of threads may read at once. A missing file is empty.

    A resumed run cuts the file and goes on: where an iteration comes again, it and all after it are made anew.
    Columns stay in memory until ``forget``. Every method raises ``OSError`` where the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, Lock()
        self.forget()

    def after(self, iteration: int) -> list[Record]:
        """The records of iterations above ``iteration``, in order."""
        with self._open() as file:
            for whole, records in _newest_first(file):
                if whole or (records and _iteration(records[0]) <= iteration):
                    kept: list[Record] = []
                    for record in records:
                        while kept and _iteration(kept[-1]) >= _iteration(record):
                            kept.pop()
                        kept.append(record)
                    return [record for record in kept if _iteration(record) > iteration]
        return []

    def last(self) -> Record | None:
        """The newest record; None before the first."""
        with self._open() as file:
            return next((records[-1] for _, records in _newest_first(file) if records), None)

    def sample(self, name: str, number: int) -> list[float | None]:
        """A metric of about ``number`` records, evenly over the file, without reading the others."""
        found: dict[int, Record] = {}
        with self._open() as file:
            size = file.seek(0, 2)
            for start in [size * index // number for index in range(number)]:
                file.seek(max(0, start - 1))
                if start:
                    file.readline(_MAX_LINE_BYTES)  # the rest of a line
                if (record := parse_record(file.readline(_MAX_LINE_BYTES))) is not None:
                    found[_iteration(record)] = record
        if (last := self.last()) is not None:
            found[_iteration(last)] = last
        return [record.get(name) for record in found.values()]

    def columns(self, names: Sequence[str] | None) -> Columns:
        """Metrics over all iterations; None for all that there are. Names that no record has are left out."""
        with self._lock, self._open() as file:
            try:
                self._catch_up(file)
            except OSError:  # in the middle of a batch
                self.forget()
                raise
            there = sorted(self._columns.keys() - set(INDEX))
            wanted = there if names is None else [name for name in names if name in self._columns and name not in INDEX]
            return Columns(
                iteration=np.array(self._iterations, dtype=np.int64),
                env_steps=np.nan_to_num(np.array(self._columns["env_steps"])).astype(np.int64),
                metrics={name: np.array(self._columns[name]) for name in wanted},  # a view would keep it from growing
                names=tuple(there),
            )

    @property
    def num_bytes(self) -> int:
        """Memory that the columns take."""
        return 8 * len(self._iterations) * len(self._columns)

    def forget(self) -> None:
        """Free the memory of all columns."""
        self._iterations = array("q")
        self._columns: dict[str, array[float]] = {}
        self._learn(["env_steps"])
        self._end, self._seal = 0, b""
        self.num_passed_over = 0
        """Lines that are no records, of those in columns."""

    def _open(self) -> BinaryIO:
        try:
            return open_regular(self._path)
        except FileNotFoundError:
            return BytesIO()

    def _catch_up(self, file: BinaryIO) -> None:
        """Add the lines that are new to the columns; a torn last one waits for its end."""
        file.seek(self._end - len(self._seal))
        if file.read(len(self._seal)) != self._seal:  # cut by a resume, or another file
            self.forget()
            file.seek(0)
        rows: list[tuple[float | None, ...]] = []
        for line in _lines(file):
            try:
                row = parse_with(self._decode, line, "record")
            except ParseError:  # no record, or one with a metric that is new, or with something that is no number
                record = parse_record(line)
                if record is not None and (new := record.keys() - self._columns.keys() - {"iteration"}):
                    self._extend(rows)
                    self._learn(sorted(new))
                row = (record["iteration"], *map(record.get, self._columns)) if record is not None else (None,)
            if row[0] is None or abs(row[0]) > MAX_ITERATION:
                self.num_passed_over += 1
                _logger.warning("%s: passing over what is no record: %r", self._path, line[:60])
            else:
                if self._iterations and row[0] <= self._iterations[-1]:
                    self._extend(rows)
                    self._cut(bisect_left(self._iterations, row[0]))
                elif len(rows) == _BATCH:
                    self._extend(rows)
                self._iterations.append(int(row[0]))
                rows.append(row)
            self._end += len(line)
            self._seal = line[-_SEAL_BYTES:]
        self._extend(rows)

    def _cut(self, size: int) -> None:
        del self._iterations[size:]
        for column in self._columns.values():
            del column[size:]

    def _extend(self, rows: list[tuple[float | None, ...]]) -> None:
        """Put decoded rows into the columns, and empty the list."""
        if rows:
            numbers: NDArray[np.float64] = np.array(rows, dtype=np.float64).T[1:].copy()
            for column, values in zip(self._columns.values(), numbers, strict=True):
                column.frombytes(values.tobytes())
            rows.clear()

    def _learn(self, names: Sequence[str]) -> None:
        """Begin a column for each of these metrics, and make the decoder of all: ten times as fast as a parser."""
        import msgspec

        self._columns.update({name: array("d", [math.nan]) * len(self._iterations) for name in names})
        keys = {f"f{index}": name for index, name in enumerate(self._columns)}
        fields: list[Any] = [("iteration", int), *((field, float | None, None) for field in keys)]
        kind = msgspec.defstruct("Line", fields, rename=keys, gc=False, forbid_unknown_fields=True)
        decode, values = msgspec.json.Decoder(kind).decode, msgspec.structs.astuple
        self._decode: Callable[[bytes], tuple[float | None, ...]] = lambda line: values(decode(line))


def parse_record(text: bytes) -> Record | None:
    """One record of JSON text; None where it is none."""
    try:
        return _check_record(parse_with(_fast_parser(), text, "record"))
    except ParseError:  # NaN, which is no JSON, or something that is no number
        with suppress(ParseError):
            return _check_record(parse_json(text, "record", allow_nan=True))
    return None


@cache
def _fast_parser() -> Callable[[bytes], Any]:
    import msgspec

    return msgspec.json.Decoder(dict[str, int | float | None]).decode


def _check_record(record: Any) -> Record | None:
    iteration = record.get("iteration") if isinstance(record, dict) else None
    if type(iteration) is not int or abs(iteration) > MAX_ITERATION:
        return None
    values = {name: value for name, value in record.items() if value is None or type(value) in (int, float)}
    return {
        name: value if value is None or abs(value) <= sys.float_info.max else None for name, value in values.items()
    }


def columns_of(records: Sequence[Record], names: Sequence[str] | None) -> Columns:
    """Records in columns."""
    there = {name for record in records for name in record if name not in INDEX}
    wanted = sorted(there) if names is None else [name for name in names if name in there]

    def column(name: str) -> NDArray[np.float64]:
        return np.array([record.get(name) for record in records], dtype=np.float64)

    return Columns(
        iteration=column("iteration").astype(np.int64),
        env_steps=np.nan_to_num(column("env_steps")).astype(np.int64),
        metrics={name: column(name) for name in wanted},
        names=tuple(sorted(there)),
    )


def _iteration(record: Record) -> int:
    return int(record["iteration"] or 0)


def _lines(file: BinaryIO) -> Iterator[bytes]:
    """Whole lines from here on. One that is too long is no record, nor is what follows it."""
    while (line := file.readline(_MAX_LINE_BYTES)).endswith(b"\n"):
        yield line


def _newest_first(file: BinaryIO) -> Iterator[tuple[bool, list[Record]]]:
    """The records at the end of a file, then those of the whole file; and which of both it is."""
    start = max(0, file.seek(0, 2) - _TAIL_BYTES)
    for begin in dict.fromkeys((start, 0)):
        file.seek(begin)
        if begin:
            file.readline(_MAX_LINE_BYTES)  # the rest of a line
        found = map(parse_record, _lines(file))
        yield begin == 0, [record for record in found if record is not None]
