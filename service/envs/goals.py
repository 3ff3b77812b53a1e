"""Where random goals lie: what Bob is evaluated on, and the Gymnasium environments ask for."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from service.config import WorldConfig
from service.envs.batch import sample_in_volume, sample_on_table

StateArray = NDArray[np.float64]
GoalKind = Literal["table", "air", "mixed"]
GOAL_KINDS: tuple[GoalKind, ...] = ("table", "air", "mixed")

MIXED_AIR_SHARE = 0.7
"""Share of mixed goals drawn anywhere in the workspace's volume; the rest lie on the table (paper: p = 0.7)."""


def sample_goals(
    kind: GoalKind, rng: np.random.Generator, num: int, config: WorldConfig, success_distance_m: float
) -> StateArray:
    """(num, 3) goals, metres.

    ``table``: on it. ``air``: out of reach of an object that rests on the table. ``mixed``: as the paper's downstream
    tasks, anywhere in the volume with probability 0.7, else on the table.
    """
    table = sample_on_table(rng, num, config.workspace, config.object_size_m)
    if kind == "table":
        return table
    if kind == "air":
        lowest = config.object_size_m / 2 + success_distance_m
        return sample_in_volume(rng, num, config.workspace, config.object_size_m, lowest_m=lowest)
    volume = sample_in_volume(rng, num, config.workspace, config.object_size_m)
    return np.where(rng.random((num, 1)) < MIXED_AIR_SHARE, volume, table)
