"""The verdict on Alice's proposals: whether each is a goal (OpenAI 2021, section 3; workspace: the paper)."""

from __future__ import annotations

import enum

import numpy as np
from numpy.typing import NDArray

from service.base.types import BoolArray, StateArray
from service.config import WorkspaceConfig

FALLEN_BELOW_M = -0.02
"""Height of the object's centre under which it has left the table; the table top is at 0."""


class Verdict(enum.IntEnum):
    """Outcome of Alice's proposal; only a ``VALID`` one is a goal."""

    VALID = 0
    NOT_MOVED = 1
    OUTSIDE = 2
    FALLEN = 3


def in_workspace(position: StateArray, workspace: WorkspaceConfig) -> BoolArray:
    """Whether each (..., 3) position in metres lies in the box, its faces included; not-a-number lies outside."""
    inside: BoolArray = np.all((position >= workspace.lower_m) & (position <= workspace.upper_m), axis=-1)
    return inside


def classify_goal(
    start_position: StateArray, end_position: StateArray, workspace: WorkspaceConfig, success_distance_m: float
) -> NDArray[np.int8]:
    """Verdict on where the object lies at the end of Alice's turn: the first reason that applies.

    Fallen (under the table top, or not finite), then not moved by MORE than the success distance, then outside the
    workspace.

    Args:
        start_position: (N, 3) object centre before her turn, metres.
        end_position: (N, 3) object centre after it, metres.
        workspace: the box in which goals are valid.
        success_distance_m: Bob's success distance, also the least move.

    Returns:
        (N,) of ``Verdict``.
    """
    fallen = ~np.all(np.isfinite(end_position), axis=-1) | (end_position[:, 2] < FALLEN_BELOW_M)
    moved = np.linalg.norm(end_position - start_position, axis=-1) > success_distance_m
    reasons = [fallen, ~moved, ~in_workspace(end_position, workspace)]
    verdicts = [Verdict.FALLEN, Verdict.NOT_MOVED, Verdict.OUTSIDE]
    return np.select(reasons, verdicts, default=Verdict.VALID).astype(np.int8)
