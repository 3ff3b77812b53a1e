"""Counts of a run's goals by time, height and distance, and of those that Bob solved.

A goal of ``goals.jsonl`` is 7 numbers: start x y z, goal x y z in metres, solved 0 or 1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.run_files import Records
from service.media.plots.figures import Array

NUM_SLICES = 30
"""Equal parts of a run's env steps."""
BIN_M = 0.025
NUM_BINS = {"height": 13, "distance": 16}
"""The last one also holds what is beyond it."""


def count_goals(records: Records, rest_height_m: float) -> dict[str, Any]:
    """Goals and solved goals by time, by height above where the object rests, and by distance from its start.

    Args:
        records: of ``goals.jsonl``.
        rest_height_m: of the object's centre on the table.

    Returns:
        For JSON: ``env_steps``, the end of the last slice of time, and of height and distance ``goals`` and ``solved``,
        for each slice a list of counts, one for each bin of 2.5 cm.
    """
    end = records[-1]["env_steps"]
    rows = [(record["env_steps"], *goal) for record in records for goal in record["goals"]]
    goals = np.array(rows, dtype=np.float64).reshape(len(rows), 8)
    goals = goals[np.isfinite(goals).all(axis=1)]
    time, start, goal, solved = goals[:, 0], goals[:, 1:4], goals[:, 4:7], goals[:, 7]
    slices = np.minimum((time / end * NUM_SLICES).astype(int), NUM_SLICES - 1)
    values = {"height": goal[:, 2] - rest_height_m, "distance": np.linalg.norm(goal - start, axis=1)}
    return {"env_steps": end} | {name: _count(slices, value, solved, name) for name, value in values.items()}


def _count(slices: NDArray[np.int64], values: Array, solved: Array, name: str) -> dict[str, list[list[int]]]:
    num_bins = NUM_BINS[name]
    bins = np.clip(np.floor(values / BIN_M).astype(int), 0, num_bins - 1)  # contact lets an object rest a hair lower
    place, num_places = slices * num_bins + bins, NUM_SLICES * num_bins
    counts = {"goals": np.bincount(place, minlength=num_places), "solved": np.bincount(place, solved, num_places)}
    return {key: count.astype(int).reshape(NUM_SLICES, num_bins).tolist() for key, count in counts.items()}
