"""A growing file of records, read again and again: only new lines are parsed, and only their places are kept."""

from __future__ import annotations

import logging
import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from service.parsing import ParseError, parse_json, parse_with
from service.regular_files import open_regular
from service.store.models import Columns, Record

INDEX = ("iteration", "env_steps")
"""Keys of every record that are no metrics."""
MAX_ITERATION = 2**53
_SEAL_BYTES = 256
_MAX_LINE_BYTES = 1024 * 1024
_TAIL_BYTES = 64 * 1024
_BATCH = 1000
"""Lines that are decoded before they become numbers of NumPy's, which need a tenth of the room."""
_EVERY = 64
"""Of so many lines with the same number of keys, one is asked which they are."""
_logger = logging.getLogger(__name__)
_Row = tuple[float | None, ...]


class RecordFile:
    """The iterations of one ``metrics.jsonl``; any number of threads may read at once. A missing file is empty.

    A resumed run cuts the file and goes on: where an iteration comes again, it and all after it are made anew.
    Metrics that were asked for in columns stay in memory until ``forget_columns``.
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
            found = [self._read(file, start) for start in self._starts[first:]]
            return [record for record in found if record is not None]

    def last(self) -> Record | None:
        """The newest record; None before the first.

        Raises:
            OSError: the file cannot be read.
        """
        with self._lock, self._open() as file:
            self._catch_up(file)
            return self._read(file, self._starts[-1]) if self._starts else None

    def columns(self, names: Sequence[str] | None) -> Columns:
        """Metrics over all iterations; None for all that there are. Names that no record has are left out.

        Raises:
            OSError: the file cannot be read.
        """
        with self._lock, self._open() as file:
            if not self._starts:  # nothing is known yet: one pass over the file finds everything
                asked = [name for name in names or () if name not in INDEX]
                self._columns.update({name: array("d") for name in ("env_steps", *asked)})
            self._catch_up(file)
            wanted = sorted(self._names) if names is None else [name for name in names if name in self._names]
            for name in self._columns.keys() - self._names - {"env_steps"}:
                del self._columns[name]
            missing = [name for name in ("env_steps", *wanted) if name not in self._columns]
            if missing:
                self._load(file, missing)
            return Columns(
                iteration=np.array(self._iterations, dtype=np.int64),
                env_steps=np.nan_to_num(np.array(self._columns["env_steps"])).astype(np.int64),
                metrics={name: np.array(self._columns[name]) for name in wanted},  # a view would keep it from growing
                names=tuple(sorted(self._names)),
            )

    def sample(self, name: str, number: int) -> list[float | None]:
        """A metric of about ``number`` records, evenly over the file, without reading the others.

        Raises:
            OSError: the file cannot be read.
        """
        with self._lock:
            known = self._columns.get(name)
            with self._open() as file:
                size = file.seek(0, 2)
                if known is not None and size == self._end and known:
                    chosen = np.unique(np.linspace(0, len(known) - 1, number).astype(int))
                    return [None if math.isnan(known[index]) else known[index] for index in chosen.tolist()]
                lines = list(_lines_of(file, size, number))
        decode = _decoder((name,))
        rows = [_row(decode, (name,), line) for line in lines]
        return [row[1] for row in rows if row is not None]

    @property
    def num_bytes(self) -> int:
        """Memory that the columns take."""
        return 8 * sum(map(len, self._columns.values()))

    def forget_columns(self) -> None:
        """Free the memory of all columns."""
        with self._lock:
            self._columns.clear()

    def _open(self) -> BinaryIO:
        try:
            return open_regular(self._path)
        except FileNotFoundError:
            return BytesIO()

    def _forget(self) -> None:
        self._iterations = array("q")
        self._starts = array("q")
        self._columns: dict[str, array[float]] = {}
        self._keys: set[str] = set()
        self._names: set[str] = set()
        self._num_keys = self._num_same = 0
        self._end, self._seal = 0, b""
        self.num_passed_over = 0
        """Lines that are no records, of those that were read."""

    def _catch_up(self, file: BinaryIO) -> None:
        """Find the lines that are new; a torn last one waits for its end."""
        file.seek(self._end - len(self._seal))
        if file.read(len(self._seal)) != self._seal:  # cut by a resume, or another file
            columns = self._columns
            self._forget()
            self._columns = {name: array("d") for name in columns}
            file.seek(0)
        names = tuple(self._columns)
        decode, rows = _decoder(names), list[_Row]()
        # a line that is longer is no record, nor is what follows it
        while (line := file.readline(_MAX_LINE_BYTES)).endswith(b"\n"):
            row = _row(decode, names, line)
            if row is None:
                self.num_passed_over += 1
                _logger.warning("%s: passing over what is no record: %r", self._path, line[:60])
            else:
                iteration = int(row[0] or 0)
                again = bool(self._iterations) and iteration <= self._iterations[-1]
                if again or len(rows) == _BATCH:
                    self._extend(names, rows)
                    rows = []
                if again:
                    self._cut(bisect_left(self._iterations, iteration))
                self._iterations.append(iteration)
                self._starts.append(self._end)
                self._note_names(line)
                rows.append(row)
            self._end += len(line)
            self._seal = line[-_SEAL_BYTES:]
        self._extend(names, rows)

    def _cut(self, size: int) -> None:
        del self._iterations[size:], self._starts[size:]
        for column in self._columns.values():
            del column[size:]

    def _note_names(self, line: bytes) -> None:
        """Learn the names of metrics from lines with another number of keys than the last, and from some others."""
        num_keys = line.count(b":")
        self._num_same = self._num_same + 1 if num_keys == self._num_keys else 0
        self._num_keys = num_keys
        if self._num_same % _EVERY == 0 and (new := keys_of(line) - self._keys):
            self._keys |= new
            self._names.update(name for name in parse_record(line) or () if name not in INDEX)

    def _load(self, file: BinaryIO, names: list[str]) -> None:
        """Read columns of all known records."""
        decode, rows = _decoder(tuple(names)), list[_Row]()
        for name in names:
            self._columns[name] = array("d")
        nothing: _Row = (None,) * (1 + len(names))
        at = 0
        file.seek(0)
        for start in self._starts:
            if start != at:
                file.seek(start)
            line = file.readline(_MAX_LINE_BYTES)
            at = start + len(line)
            rows.append(_row(decode, tuple(names), line) or nothing)
            if len(rows) == _BATCH:
                self._extend(names, rows)
                rows = []
        self._extend(names, rows)

    def _extend(self, names: Sequence[str], rows: list[_Row]) -> None:
        if not rows or not names:
            return
        numbers: NDArray[np.float64] = np.array(rows, dtype=np.float64).T[1:].copy()
        for name, values in zip(names, numbers, strict=True):
            self._columns[name].frombytes(values.tobytes())

    def _read(self, file: BinaryIO, start: int) -> Record | None:
        file.seek(start)
        return parse_record(file.readline(_MAX_LINE_BYTES))


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


@lru_cache(256)
def _decoder(names: tuple[str, ...]) -> Callable[[bytes], _Row]:
    """A parser of lines that keeps the iteration and these metrics, and passes over all others: 20 times as fast."""
    import msgspec

    fields = {f"f{index}": name for index, name in enumerate(names)}
    kinds: list[tuple[str, Any, Any]] = [(field, float | None, None) for field in fields]
    kind = msgspec.defstruct("Line", [("iteration", int), *kinds], rename=fields, gc=False)
    decode, values = msgspec.json.Decoder(kind).decode, msgspec.structs.astuple
    return lambda line: values(decode(line))


def keys_of(line: bytes) -> set[str]:
    """The keys of a line; empty where it is no object."""
    import msgspec

    try:
        return set(parse_with(lambda text: msgspec.json.decode(text, type=dict[str, msgspec.Raw]), line, "record"))
    except ParseError:
        return set(parse_record(line) or ())


def _row(decode: Callable[[bytes], _Row], names: Sequence[str], line: bytes) -> _Row | None:
    """The iteration of a line and its metrics; None where it is no record."""
    try:
        row = parse_with(decode, line, "record")
    except ParseError:  # NaN, or text where a number should be
        record = parse_record(line)
        if record is None:
            return None
        row = (record["iteration"], *(record.get(name) for name in names))
    return row if abs(row[0] or 0) < MAX_ITERATION else None


def _lines_of(file: BinaryIO, size: int, number: int) -> Iterator[bytes]:
    """Whole lines of a file, about ``number`` of them, evenly over its bytes; the first and the last among them."""
    last = -1
    for index in range(number):
        start = size * index // number
        file.seek(max(0, start - 1))
        if start > 0:
            file.readline(_MAX_LINE_BYTES)  # the rest of a line
        at = file.tell()
        if at > last and (line := file.readline(_MAX_LINE_BYTES)).endswith(b"\n"):
            last = at
            yield line
    base = max(0, size - _TAIL_BYTES)
    file.seek(base)
    tail = file.read(size - base)
    end = tail.rfind(b"\n")
    begin = tail.rfind(b"\n", 0, max(0, end)) + 1
    if end > begin and base + begin > last and (begin or not base):
        yield tail[begin : end + 1]
