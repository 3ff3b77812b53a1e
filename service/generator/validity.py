"""Is Alice's proposal a goal? One verdict per world (OpenAI 2021, section 3; workspace: the paper)."""

from __future__ import annotations

import enum

import numpy as np
from numpy.typing import NDArray

from service.config import WorkspaceConfig

FALLEN_BELOW_M = -0.02
"""Height of the object's centre under which it has left the table; the table top is at 0."""


class Verdict(enum.IntEnum):
    """What became of Alice's proposal; only a ``VALID`` one is a goal."""

    VALID = 0
    NOT_MOVED = 1
    OUTSIDE = 2
    FALLEN = 3


def workspace_bounds(workspace: WorkspaceConfig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper corner (3,) of the workspace box, metres; it stands on the table top."""
    center = np.array([workspace.center_x_m, workspace.center_y_m])
    half = np.array([workspace.length_x_m, workspace.length_y_m]) / 2
    return np.append(center - half, 0.0), np.append(center + half, workspace.height_m)


def in_workspace(position: NDArray[np.float64], workspace: WorkspaceConfig) -> NDArray[np.bool_]:
    """Whether each (..., 3) position in metres lies in the box, its faces included; not-a-number lies outside."""
    lower, upper = workspace_bounds(workspace)
    inside: NDArray[np.bool_] = np.all((position >= lower) & (position <= upper), axis=-1)
    return inside


def judge(
    start_position: NDArray[np.float64],
    end_position: NDArray[np.float64],
    workspace: WorkspaceConfig,
    success_distance_m: float,
) -> NDArray[np.int8]:
    """Judge where the object lies at the end of Alice's turn; the first reason that applies is the verdict.

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
