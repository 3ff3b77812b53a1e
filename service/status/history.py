"""A run's metrics in columns, kept between requests: pages ask again and again, and a long run has 100 MB of them."""

from __future__ import annotations

from array import array
from collections import OrderedDict
from collections.abc import Sequence
from datetime import datetime
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from service.status.shapes import MetricHistory
from service.store.models import Record, RunReader

MAX_RUNS = 8
_INDEX = ("iteration", "env_steps")


class Histories:
    """The metrics of the runs last asked for; any number of threads may ask at once."""

    def __init__(self, runs: RunReader) -> None:
        """Nothing is read before the first call."""
        self._runs = runs
        self._known: OrderedDict[tuple[str, datetime], _Columns] = OrderedDict()
        self._lock = Lock()

    def history(self, run_id: str, names: Sequence[str] | None, after_iteration: int, max_points: int) -> MetricHistory:
        """Metrics of a run.

        Args:
            run_id: the run.
            names: of metrics, those the run does not have are left out; None for all.
            after_iteration: only later iterations.
            max_points: as many points are made of them, each the mean of neighbouring iterations.

        Raises:
            UnknownRunError: there is no such run.
            StoreUnavailableError: the runs cannot be read.
        """
        # a run that was resumed makes its last iterations anew, so what is known of it is known of one start
        key = (run_id, self._runs.run(run_id).started)
        with self._lock:
            columns = self._known.setdefault(key, _Columns())
            self._known.move_to_end(key)
            while len(self._known) > MAX_RUNS:
                self._known.popitem(last=False)
        with columns.lock:
            columns.update(self._runs, run_id)
            return columns.select(run_id, names, after_iteration, max_points)


class _Columns:
    def __init__(self) -> None:
        self.lock = Lock()
        self._forget()

    def _forget(self) -> None:
        self._columns: dict[str, array[float]] = {name: array("d") for name in _INDEX}
        self._last = 0

    def update(self, runs: RunReader, run_id: str) -> None:
        """Read what is new; the last record known is read again, for it is gone when the history was cut."""
        records = runs.metrics(run_id, after_iteration=max(0, self._last - 1))
        if self._last and (not records or records[0]["iteration"] != self._last):
            self._forget()
            records = runs.metrics(run_id)
        for record in records[1 if self._last else 0 :]:
            self._append(record)

    def _append(self, record: Record) -> None:
        size = len(self._columns["iteration"])
        for name, value in record.items():
            column = self._columns.setdefault(name, array("d"))
            column.extend([np.nan] * (size - len(column)))
            column.append(np.nan if value is None else value)
        self._last = int(record["iteration"] or 0)

    def select(self, run_id: str, names: Sequence[str] | None, after: int, max_points: int) -> MetricHistory:
        iterations = self._column("iteration")
        first = int(np.searchsorted(iterations, after, side="right"))
        size = len(iterations) - first
        starts = np.linspace(0, size, min(size, max_points), endpoint=False).astype(int)
        ends = np.append(starts[1:], size)[: len(starts)] - 1
        known = [name for name in self._columns if name not in _INDEX]
        wanted = known if names is None else [name for name in dict.fromkeys(names) if name in self._columns]
        return MetricHistory(
            run_id=run_id,
            last_iteration=self._last,
            num_iterations=size,
            iteration=tuple(iterations[first:][ends].astype(int).tolist()),
            env_steps=tuple(np.nan_to_num(self._column("env_steps")[first:][ends]).astype(int).tolist()),
            metrics={name: _means(self._column(name)[first:], starts) for name in wanted if name not in _INDEX},
            names=tuple(sorted(known)),
        )

    def _column(self, name: str) -> NDArray[np.float64]:
        """A copy, for an array cannot grow while a view of it lives; as long as all others."""
        column = np.array(self._columns[name])
        missing = len(self._columns["iteration"]) - len(column)
        return np.concatenate([column, np.full(missing, np.nan)])


def _means(values: NDArray[np.float64], starts: NDArray[np.int_]) -> tuple[float | None, ...]:
    """The mean of the numbers in each part that begins at ``starts``; None where it has none."""
    there = ~np.isnan(values)
    counts = np.add.reduceat(there.astype(int), starts)
    sums = np.add.reduceat(np.where(there, values, 0.0), starts)
    return tuple(total / count if count else None for total, count in zip(sums.tolist(), counts.tolist(), strict=True))
