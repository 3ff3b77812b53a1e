"""Curves of runs, thinned: what a picture shows of ten thousand iterations needs a thousand points."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.base.errors import StoreError
from service.status.schemas import Axis, MetricHistory
from service.store.models import Columns, RunReader

MAX_NUMBERS = 1_000_000
"""In one answer, about 10 MB: where many curves are asked for, each has fewer points."""
MIN_POINTS = 20
_WALL = "time/wall_s"
_DIGITS = 6
_CSV_ROWS = 500
_Floats = NDArray[np.float64]


def history(
    runs: RunReader, run_id: str, names: Sequence[str] | None, after_iteration: int, max_points: int
) -> MetricHistory:
    """Metrics of a run after an iteration, down-sampled to points that are the mean of neighbouring iterations.

    Names that the run does not have are left out; None for all metrics.

    Raises:
        UnknownRunError: there is no such run.
        StoreUnavailableError: the runs cannot be read.
    """
    found = runs.columns(run_id, None if names is None else list(dict.fromkeys(names)))
    first = int(np.searchsorted(found.iteration, after_iteration, side="right"))
    size = len(found.iteration) - first
    starts = _parts(size, max_points)
    ends = np.append(starts[1:], size)[: len(starts)] - 1
    return MetricHistory(
        run_id=run_id,
        last_iteration=_last(found),
        num_iterations=size,
        iteration=tuple(found.iteration[first:][ends].tolist()),
        env_steps=tuple(found.env_steps[first:][ends].tolist()),
        metrics={
            name: tuple(None if math.isnan(value) else value for value in _means(values[first:], starts).tolist())
            for name, values in found.metrics.items()
        },
        names=found.names,
    )


def series(
    runs: RunReader,
    run_ids: Sequence[str],
    names: Sequence[str],
    axis: Axis,
    start: float | None,
    end: float | None,
    max_points: int,
) -> dict[str, Any]:
    """The same metrics of several runs, as a ``SeriesSet``.

    A run that cannot be read has its problem in place of curves, so that the others are shown.

    Args:
        runs: where they are.
        run_ids: of the runs.
        names: of metrics; a run without one has no such curve.
        axis: what the curves are over.
        start: first value of the axis; None for the first there is.
        end: last value; None for the newest.
        max_points: of a curve. Of more, neighbours are put together, with their mean, their lowest and their highest.
    """
    numbers = MAX_NUMBERS // max(1, len(run_ids) * len(names))
    points = max(MIN_POINTS, min(max_points, numbers))
    return {"axis": axis, "runs": [_one(runs, run_id, names, axis, start, end, points) for run_id in run_ids]}


def _one(
    runs: RunReader, run_id: str, names: Sequence[str], axis: Axis, start: float | None, end: float | None, points: int
) -> dict[str, Any]:
    try:
        found = runs.columns(run_id, list(dict.fromkeys([*names, _WALL])) if axis == "wall_s" else names)
    except StoreError as error:
        nothing: dict[str, Any] = {"last_iteration": 0, "num_iterations": 0, "x": [], "curves": {}, "names": []}
        return {"run_id": run_id, **nothing, "problem": str(error)}
    x = axis_of(found, axis)
    # one further on each side, so that lines go on to the edges of a picture
    first = max(0, int(np.searchsorted(x, start)) - 1) if start is not None else 0
    last = int(np.searchsorted(x, end, side="right")) + 1 if end is not None else len(x)
    x = x[first:last]
    whole = len(x) <= points
    starts = _parts(len(x), points if whole else points // 2)
    curves = {}
    for name in names:
        if name in found.metrics:
            values = found.metrics[name][first:last]
            low = None if whole else _rounded(np.fmin.reduceat(values, starts))
            high = None if whole else _rounded(np.fmax.reduceat(values, starts))
            curves[name] = {"mean": _rounded(_means(values, starts)), "low": low, "high": high}
    ends = np.append(starts[1:], len(x))[: len(starts)] - 1
    return {
        "run_id": run_id,
        "last_iteration": _last(found),
        "num_iterations": len(x),
        "x": x[ends].tolist(),
        "curves": curves,
        "names": list(found.names),
        "problem": None,
    }


def table(runs: RunReader, run_ids: Sequence[str], names: Sequence[str]) -> Iterator[str]:
    """Every iteration's metrics of some runs as CSV, in pieces; a run that cannot be read has no rows."""
    yield _lines([("run", "iteration", "env_steps", *names)])
    for run_id in run_ids:
        try:
            found = runs.columns(run_id, names)
        except StoreError:
            continue
        nothing = np.full(len(found.iteration), np.nan)
        columns = [found.metrics.get(name, nothing) for name in names]
        for first in range(0, len(found.iteration), _CSV_ROWS):
            part = slice(first, first + _CSV_ROWS)
            numbers = [["" if math.isnan(value) else value for value in column[part].tolist()] for column in columns]
            index = found.iteration[part].tolist(), found.env_steps[part].tolist()
            yield _lines([(run_id, *row) for row in zip(*index, *numbers, strict=True)])


def axis_of(found: Columns, axis: Axis) -> _Floats:
    """The values of an axis, which never fall."""
    if axis == "iteration":
        return found.iteration.astype(np.float64)
    values = found.env_steps.astype(np.float64) if axis == "env_steps" else found.metrics.get(_WALL)
    if values is None:
        return np.zeros(len(found.iteration))
    return np.maximum.accumulate(np.nan_to_num(values))


def _last(found: Columns) -> int:
    return int(found.iteration[-1]) if len(found.iteration) else 0


def _parts(size: int, number: int) -> NDArray[np.int_]:
    """Where the parts begin, at most ``number`` and of about equal size."""
    return np.linspace(0, size, min(size, number), endpoint=False).astype(int)


def _means(values: _Floats, starts: NDArray[np.int_]) -> _Floats:
    """The mean of the numbers in each part; NaN if it has none."""
    known = ~np.isnan(values)
    counts = np.add.reduceat(known.astype(int), starts)
    sums = np.add.reduceat(np.where(known, values, 0.0), starts)
    means: _Floats = np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)
    return means


def _rounded(values: _Floats) -> list[float]:
    """As many digits as a picture shows: whole ones would make the answer twice as long. NaN becomes null in JSON."""
    size = np.where((values == 0) | np.isnan(values), 1.0, np.abs(values))
    decimals = _DIGITS - 1 - np.floor(np.log10(size))
    scale = 10.0 ** np.clip(decimals, -300, 300)
    rounded: list[float] = (np.round(values * scale) / scale).tolist()
    return rounded


def _lines(rows: Sequence[Sequence[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
