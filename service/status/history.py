"""Metrics of runs in columns, kept in memory between requests: the records of a long run are 100 MB."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from functools import lru_cache
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from service.status.schemas import MetricHistory
from service.store.models import Record, RunReader

MAX_RUNS = 8
_INDEX = ("iteration", "env_steps")


class HistoryCache:
    """A cache of the metrics of the last ``MAX_RUNS`` runs that were asked for; thread-safe."""

    def __init__(self, runs: RunReader) -> None:
        self._runs = runs
        self._columns = lru_cache(MAX_RUNS)(lambda *_: _Columns())

    def history(self, run_id: str, names: Sequence[str] | None, after_iteration: int, max_points: int) -> MetricHistory:
        """Metrics of a run after an iteration, down-sampled to points that are the mean of neighbouring iterations.

        Names that the run does not have are left out; None for all metrics.

        Raises:
            UnknownRunError: there is no such run.
            StoreUnavailableError: the runs cannot be read.
        """
        # the key has the start: a resumed run makes its last iterations again
        columns = self._columns(run_id, self._runs.run(run_id).started)
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
        """Read new records, and the last known one again: it is gone if the history was cut."""
        records = runs.metrics(run_id, after_iteration=max(0, self._last - 1))
        if self._last and (not records or records[0]["iteration"] != self._last):
            self._forget()
            records = runs.metrics(run_id)
        for record in records[1 if self._last else 0 :]:
            self._append(record)

    def _append(self, record: Record) -> None:
        size = len(self._columns["iteration"])
        for name in record:
            if name not in self._columns:
                self._columns[name] = array("d", [np.nan] * size)
        for name, column in self._columns.items():
            value = record.get(name)
            column.append(np.nan if value is None else value)
        self._last = int(record["iteration"] or 0)

    def select(self, run_id: str, names: Sequence[str] | None, after: int, max_points: int) -> MetricHistory:
        # copies, because an array cannot grow while a view of it exists
        iterations, env_steps = (np.array(self._columns[name]) for name in _INDEX)
        first = int(np.searchsorted(iterations, after, side="right"))
        size = len(iterations) - first
        starts = np.linspace(0, size, min(size, max_points), endpoint=False).astype(int)
        ends = np.append(starts[1:], size)[: len(starts)] - 1
        known = [name for name in self._columns if name not in _INDEX]
        wanted = known if names is None else [name for name in dict.fromkeys(names) if name in known]
        return MetricHistory(
            run_id=run_id,
            last_iteration=self._last,
            num_iterations=size,
            iteration=tuple(iterations[first:][ends].astype(int).tolist()),
            env_steps=tuple(np.nan_to_num(env_steps[first:][ends]).astype(int).tolist()),
            metrics={name: _means(np.array(self._columns[name])[first:], starts) for name in wanted},
            names=tuple(sorted(known)),
        )


def _means(values: NDArray[np.float64], starts: NDArray[np.int_]) -> tuple[float | None, ...]:
    """The mean of the numbers in each part that begins at ``starts``; None if it has none."""
    known = ~np.isnan(values)
    counts = np.add.reduceat(known.astype(int), starts)
    sums = np.add.reduceat(np.where(known, values, 0.0), starts)
    return tuple(total / count if count else None for total, count in zip(sums.tolist(), counts.tolist(), strict=True))
