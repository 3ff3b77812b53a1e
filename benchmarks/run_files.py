"""The small file of a run that ``docs/results/runs`` keeps: how its series are thinned, and how it is read back.

A run of hours has thousands of iterations. Consecutive ones are joined to at most 300 points: a point holds the mean
of each metric over the iterations that have it, and the last value of the counters (iteration, env steps, wall-clock
time).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.base.types import StateArray
from service.media.figures import column

FORMAT_VERSION = 1
"""Of the files of runs and of trials; no reader asks for it so far."""
MAX_POINTS = 300
"""Most points of a series."""
COUNTERS = ("iteration", "env_steps", "time/wall_s")
STAGES = {"beginning": 0.0, "middle": 0.5, "end": 1.0}
"""Shares of the run at which coverage is measured."""
RANDOM = "random policy"
_DIGITS = 5

Run = dict[str, Any]
Records = Sequence[dict[str, Any]]


def thin(
    records: Records, max_points: int = MAX_POINTS, kept: tuple[str, ...] = ("",)
) -> dict[str, list[float | None]]:
    """Each metric as a list of at most ``max_points`` means over equal blocks of records; null where none had it.

    ``kept`` are the beginnings of the names of metrics that are kept.
    """
    parts = blocks(len(records), max_points)
    names = {key for record in records for key in record if key.startswith(kept)}
    keys = sorted(names, key=lambda key: (key not in COUNTERS, key))
    series = {}
    for key in keys:
        values = column(records, key)
        points = [values[part][-1:] if key in COUNTERS else values[part] for part in parts]
        series[key] = [_rounded(point[np.isfinite(point)], key) for point in points]
    return series


def unthin(series: dict[str, list[float | None]]) -> list[dict[str, Any]]:
    """A record for each point, as ``metrics.jsonl`` has them: what was null is left out."""
    rows = zip(*series.values(), strict=True)
    return [{key: value for key, value in zip(series, row, strict=True) if value is not None} for row in rows]


def blocks(num: int, max_blocks: int) -> list[NDArray[np.int64]]:
    """The places 0 to ``num`` - 1 in at most ``max_blocks`` consecutive parts of equal size."""
    return np.array_split(np.arange(num), min(num, max_blocks))


def binned(records: Records, key: str, num_bins: int, *, over: str = "env_steps") -> StateArray:
    """Means of a metric in ``num_bins`` equal spans of a counter from 0 to its end, NaN where a span has none."""
    at, values = column(records, over), column(records, key)
    known = np.isfinite(values) & np.isfinite(at)
    index = np.minimum((at[known] / np.nanmax(at) * num_bins).astype(int), num_bins - 1)
    with np.errstate(invalid="ignore"):  # 0 / 0 where a span has none
        return np.bincount(index, values[known], num_bins) / np.bincount(index, minlength=num_bins)


def steps_until(records: Records, key: str, level: float, *, num_in_a_row: int = 3) -> int | None:
    """Env steps after which the mean of so many evaluations in a row was first at ``level``; None: never.

    A single evaluation has too few goals: noise would be first.
    """
    evaluated = [record for record in records if key in record]
    for last in range(num_in_a_row - 1, len(evaluated)):
        row = evaluated[last - num_in_a_row + 1 : last + 1]
        if float(np.mean([record[key] for record in row])) >= level:
            return int(row[-1]["env_steps"])
    return None


def mean_share(stage: Mapping[str, Any]) -> float:
    """Mean share of the cells visited, over all sets of a stage."""
    return float(np.mean(stage["shares"]))


def paths_m(stage: Mapping[str, Any]) -> StateArray:
    """The kept paths of a stage, (number, points, 3) metres."""
    flat = np.array(stage["paths_mm"], dtype=np.float64) / 1000
    return flat.reshape(len(flat), -1, 3)


def _rounded(values: StateArray, key: str) -> float | None:
    if not values.size:
        return None
    mean = float(values.mean())
    return int(mean) if key in ("iteration", "env_steps") else float(f"{mean:.{_DIGITS}g}")
