"""Bins of goals: cells of the workspace, heights, distances, and kinds of task."""

from __future__ import annotations

import numpy as np

from service.base.types import Array, BoolArray, IntArray, StateArray
from service.config import WorldConfig
from service.config.self_play import SelfPlayConfig
from service.envs.state_layout import StateLayout, obstacle_columns

AIR_ABOVE_REST_M = 0.05
"""A goal is in the air when the object's centre is higher than it rests on the table by more than this."""
HEIGHT_EDGES_M = (0.10, 0.20)
"""Heights above the resting height that part low from middle and middle from high air goals."""
HEIGHT_NAMES = ("table", "low", "middle", "high")
DISTANCE_EDGES_M = (0.10, 0.15, 0.20, 0.30)
"""Distances from the start that part the distance bins."""
NUM_DISTANCE_BINS = len(DISTANCE_EDGES_M) + 1
NUM_TASK_BINS = len(HEIGHT_NAMES) * NUM_DISTANCE_BINS


def in_air(positions: StateArray, rest_height_m: float) -> BoolArray:
    """Whether an object at each (..., 3) position is lifted rather than lying (or tilting) on the table."""
    lifted: BoolArray = positions[..., 2] > rest_height_m + AIR_ABOVE_REST_M
    return lifted


def height_bins(positions: StateArray, rest_height_m: float) -> IntArray:
    """(M,) index into ``HEIGHT_NAMES`` of (M, 3) positions; bin 0 is exactly what is not ``in_air``."""
    edges = rest_height_m + np.array([AIR_ABOVE_REST_M, *HEIGHT_EDGES_M])
    return np.digitize(positions[:, 2], edges, right=True).astype(np.int64)


def distance_bins(goals: StateArray, start_positions: StateArray) -> IntArray:
    """(M,) bin between ``DISTANCE_EDGES_M`` of the way from (M, 3) starts to (M, 3) goals, metres."""
    distance: StateArray = np.linalg.norm(goals - start_positions, axis=-1)
    return np.digitize(distance, DISTANCE_EDGES_M).astype(np.int64)


CELL_SIZE_M = 0.05
"""Usual edge of a goal cell."""


class GoalCells:
    """Cells that cover the workspace."""

    def __init__(self, world: WorldConfig, cell_size_m: float) -> None:
        self.bounds_m = world.workspace.lower_m, world.workspace.upper_m
        """Lower and upper corner of the workspace, metres."""
        self._lower: StateArray = np.array(self.bounds_m[0])
        self.cell_size_m = cell_size_m
        """Edge of a cell; the last ones may reach beyond the workspace."""
        # Rounding may not add a cell: 0.45 / 0.03 is a little over 15.
        counted = np.ceil((self.bounds_m[1] - self._lower) / cell_size_m - 1e-9).astype(int)
        self.shape = (int(counted[0]), int(counted[1]), int(counted[2]))
        """Number of cells in x, y and z."""

    def __len__(self) -> int:
        """Number of cells."""
        return int(np.prod(self.shape))

    def index(self, goals: StateArray) -> IntArray:
        """(M,) flat cell of each of (M, 3) goals inside the workspace, metres; upper faces belong to the last cells."""
        index = np.floor((goals - self._lower) / self.cell_size_m).astype(np.int64)
        index = np.clip(index, 0, np.array(self.shape) - 1)
        return np.ravel_multi_index((index[:, 0], index[:, 1], index[:, 2]), self.shape).astype(np.int64)

    def count(self, goals: StateArray) -> IntArray:
        """(cells,) how many of (M, 3) goals lie in each cell."""
        return np.bincount(self.index(goals), minlength=len(self))

    def centers(self) -> Array:
        """(cells, 3) middle of each cell, metres."""
        index = np.stack(np.unravel_index(np.arange(len(self)), self.shape), axis=-1)
        centers: Array = self._lower + (index + 0.5) * self.cell_size_m
        return centers


class TaskBins:
    """Bins of tasks, a task being a goal and a start, by what makes them hard for Bob.

    They are the goal's height, its distance from the object's start, and the gripper: it is free, it holds the object
    already, or, where a run blocks some grippers, it is blocked.

    Args:
        config: the run.
        layout: of its worlds' states.
    """

    def __init__(self, config: SelfPlayConfig, layout: StateLayout) -> None:
        self.rest_height_m = config.world.rest_height_m
        """Height of the centre of an object that lies on the table."""
        self.some_blocked = config.game.blocked_gripper_fraction > 0.0
        self.obstacles = obstacle_columns(layout, len(config.world.obstacles))
        """Columns of a state that hold poses of obstacles."""
        self._contacts = layout["contacts"]
        self._gripper_blocked = layout["gripper_blocked"]  # columns that say so; none where worlds have no such flag

    def __len__(self) -> int:
        """Number of bins."""
        return NUM_TASK_BINS * (2 + self.some_blocked)

    def index(self, goals: StateArray, start_positions: StateArray, start_states: StateArray) -> IntArray:
        """(M,) bin of each task: (M, 3) goal, (M, 3) position of the object and (M, S) state at the start."""
        bins = height_bins(goals, self.rest_height_m) * NUM_DISTANCE_BINS + distance_bins(goals, start_positions)
        kind: IntArray = self.held(start_states) + 2 * self.blocked(start_states).astype(np.int64)
        return bins + kind * NUM_TASK_BINS

    def held(self, states: StateArray) -> BoolArray:
        """(M,) whether in (M, S) states a free gripper holds the object: both fingers touched it."""
        held: BoolArray = (states[:, self._contacts] > 0.0).all(axis=1) & ~self.blocked(states)
        return held

    def blocked(self, states: StateArray) -> BoolArray:
        """(M,) whether the gripper of (M, S) states is blocked; none is where states have no such flag."""
        blocked: BoolArray = np.any(states[:, self._gripper_blocked] > 0.0, axis=1)
        return blocked
