"""The verdict on Alice's proposals: whether each is a goal (OpenAI 2021, section 3; workspace: the paper)."""

from __future__ import annotations

import enum

import numpy as np
from numpy.typing import NDArray

from service.base.types import BoolArray, FloatArray, StateArray
from service.config import WorkspaceConfig
from service.envs.observations import distances, each_object

FALLEN_BELOW_M = -0.02
"""Height of the object's centre under which it has left the table; the table top is at 0."""


class Verdict(enum.IntEnum):
    """Outcome of Alice's proposal; only a ``VALID`` one is a goal."""

    VALID = 0
    NOT_MOVED = 1
    OUTSIDE = 2
    FALLEN = 3


NO_GOAL = {
    Verdict.NOT_MOVED: "nothing was moved far",
    Verdict.OUTSIDE: "it left the workspace",
    Verdict.FALLEN: "it fell off the table",
}
"""Why a proposal is no goal, as people are told."""


def in_workspace(position: FloatArray | StateArray, workspace: WorkspaceConfig) -> BoolArray:
    """Whether each (..., 3) position in metres lies in the box, its faces included; not-a-number lies outside."""
    inside: BoolArray = np.all((position >= workspace.lower_m) & (position <= workspace.upper_m), axis=-1)
    return inside


def proposed(start_position: StateArray, end_position: StateArray, success_distance_m: float) -> StateArray:
    """(N, 3 K) goal of each turn: where the objects are. What it did not move, while it moved another, is to stay.

    Args:
        start_position: (N, 3 K) object centres before, metres.
        end_position: (N, 3 K) object centres after it, metres.
        success_distance_m: least move.
    """
    moved = distances(end_position, start_position) > success_distance_m
    kept = ~moved & moved.any(axis=1, keepdims=True)
    return np.where(np.repeat(kept, 3, axis=1), start_position, end_position)


def classify_goal(
    start_position: StateArray, end_position: StateArray, workspace: WorkspaceConfig, success_distance_m: float
) -> NDArray[np.int8]:
    """Verdict on where the objects lie at the end of Alice's turn: the first reason that applies.

    One has fallen (under the table top, or not finite), then none has moved by MORE than the success distance, then one
    is outside the workspace.

    Args:
        start_position: (N, 3 K) object centres before her turn, metres.
        end_position: (N, 3 K) object centres after it, metres.
        workspace: the box in which goals are valid.
        success_distance_m: Bob's success distance, also the least move.

    Returns:
        (N,) of ``Verdict``.
    """
    end = each_object(end_position)
    fallen = ~np.all(np.isfinite(end_position), axis=-1) | (end[..., 2] < FALLEN_BELOW_M).any(axis=-1)
    moved = (distances(end_position, start_position) > success_distance_m).any(axis=-1)
    reasons = [fallen, ~moved, ~in_workspace(end, workspace).all(axis=-1)]
    verdicts = [Verdict.FALLEN, Verdict.NOT_MOVED, Verdict.OUTSIDE]
    return np.select(reasons, verdicts, default=Verdict.VALID).astype(np.int8)
