"""Random goals, for the evaluation of Bob and for the Gymnasium environments."""

from __future__ import annotations

from typing import Literal

import numpy as np

from service.config import WorldConfig
from service.envs.sampling import behind_wall, in_box, sample_in_volume, sample_on_table
from service.errors import TandemError
from service.types import StateArray

GoalKind = Literal["table", "air", "mixed", "volume"]
GOAL_KINDS: tuple[GoalKind, ...] = ("table", "air", "mixed", "volume")

MIXED_AIR_SHARE = 0.7
"""Share of mixed goals drawn anywhere in the workspace's volume; the rest lie on the table (paper: p = 0.7)."""


def sample_goals(
    kind: GoalKind, rng: np.random.Generator, num: int, config: WorldConfig, success_distance_m: float
) -> StateArray:
    """(num, 3) goals, metres.

    ``table``: on it. ``air``: out of reach of an object that rests on the table. ``volume``: anywhere in the workspace
    (p = 1 in the paper's words). ``mixed``: as most of the paper's downstream tasks, anywhere in the volume with
    probability 0.7, else on the table.
    """
    table = sample_on_table(rng, num, config.workspace, config.object_size_m)
    if kind == "table":
        return table
    if kind == "air":
        lowest = config.object_size_m / 2 + success_distance_m
        return sample_in_volume(rng, num, config.workspace, config.object_size_m, lowest_m=lowest)
    volume = sample_in_volume(rng, num, config.workspace, config.object_size_m)
    if kind == "volume":
        return volume
    return np.where(rng.random((num, 1)) < MIXED_AIR_SHARE, volume, table)


def draw_goals(
    kind: GoalKind,
    rng: np.random.Generator,
    config: WorldConfig,
    success_distance_m: float,
    *,
    start: StateArray,
    box: StateArray,
) -> StateArray:
    """(num, 3) goals for worlds at their start, metres: behind the wall, in the box, or else ``sample_goals``.

    Args:
        kind: where goals are; in a world with a fixture only ``table``.
        rng: random numbers.
        config: the worlds.
        success_distance_m: see ``sample_goals``.
        start: (num, 3) where the objects are.
        box: (num, 3) rows of ``WorldBatch.box_place``, (num, 0) in worlds without.

    Raises:
        TandemError: goals off the table in a world with a fixture.
    """
    if config.fixture == "none":
        return sample_goals(kind, rng, len(start), config, success_distance_m)
    check_goals(kind, config)
    return behind_wall(rng, start, config) if config.fixture == "wall" else in_box(box, config)


def check_goals(kind: GoalKind, config: WorldConfig) -> None:
    """Refuse goals that a world cannot have.

    Raises:
        TandemError: an unknown kind, or goals off the table in a world with a fixture.
    """
    if kind not in GOAL_KINDS:
        raise TandemError(f"goals = {kind!r}; choose one of {', '.join(GOAL_KINDS)}")
    if config.fixture != "none" and kind != "table":
        where = {"wall": "behind it", "box": "in it"}[config.fixture]
        raise TandemError(f"goals = {kind!r} with a {config.fixture}: its goals lie {where}; choose table")
