"""Bins of goals: cells of the workspace, heights, distances, and kinds of task."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from service.base.types import Array, BoolArray, IntArray, StateArray
from service.config import WorldConfig
from service.config.run import CELL_SIZE_M
from service.config.self_play import SelfPlayConfig
from service.envs.observations import distances, each_object
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
    """(M,) bin between ``DISTANCE_EDGES_M`` of the longest way from (M, 3 K) starts to (M, 3 K) goals, metres."""
    distance: StateArray = distances(goals, start_positions).max(axis=1)
    return np.digitize(distance, DISTANCE_EDGES_M).astype(np.int64)


def highest(places: StateArray, world: WorldConfig) -> StateArray:
    """(M, 3) place of the object that is highest above where it rests, of (M, 3 K), as high as the first would be."""
    place = each_object(places)
    raised = place[:, :, 2] - np.subtract(world.rest_heights_m, world.rest_height_m)
    rows, first = np.arange(len(place)), raised.argmax(axis=1)
    return np.column_stack([place[rows, first, :2], raised[rows, first]])


ONE_MOVED, SEVERAL_MOVED, STACKED = range(3)
"""Arrangements: one object is elsewhere than at the start, several are, or one rests on another."""
ARRANGEMENT_NAMES = ("one", "several", "stacked")
NUM_ARRANGEMENTS = len(ARRANGEMENT_NAMES)
_STACKED_WITHIN_M = 0.01, 0.025
"""Up and sideways, of the place where the middle of one is exactly above the other's."""


class GoalCells:
    """Cells that cover the workspace, as many for each object."""

    def __init__(self, world: WorldConfig, cell_size_m: float = CELL_SIZE_M) -> None:
        self.bounds_m = world.workspace.lower_m, world.workspace.upper_m
        """Lower and upper corner of the workspace, metres."""
        self._lower: StateArray = np.array(self.bounds_m[0])
        self.cell_size_m = cell_size_m
        """Edge of a cell; the last ones may reach beyond the workspace."""
        # Rounding may not add a cell: 0.45 / 0.03 is a little over 15.
        counted = np.ceil((self.bounds_m[1] - self._lower) / cell_size_m - 1e-9).astype(int)
        self.shape = (int(counted[0]), int(counted[1]), int(counted[2]))
        """Number of cells in x, y and z."""
        self.num_objects = world.num_objects
        """K."""
        self.num_arrangements = NUM_ARRANGEMENTS if self.num_objects > 1 else 0
        """Of several objects."""

    def __len__(self) -> int:
        """Number of cells, those of the first object first."""
        return self.num_objects * int(np.prod(self.shape))

    def index(self, places: StateArray) -> IntArray:
        """(M, K) flat cells of objects at (M, 3 K) inside the workspace; upper faces belong to the last cells."""
        index = np.floor((each_object(places) - self._lower) / self.cell_size_m).astype(np.int64)
        index = np.clip(index, 0, np.array(self.shape) - 1)
        cell = np.ravel_multi_index((index[..., 0], index[..., 1], index[..., 2]), self.shape).astype(np.int64)
        return cell + np.arange(self.num_objects) * int(np.prod(self.shape))

    def of_moved(self, goals: StateArray, starts: StateArray) -> IntArray:
        """(M,) flat cell of each goal of (M, 3 K): where the object lies that goes furthest from (M, 3 K) starts."""
        furthest = distances(goals, starts).argmax(axis=1)
        of_it: IntArray = self.index(goals)[np.arange(len(goals)), furthest]
        return of_it

    def count(self, index: IntArray) -> IntArray:
        """(cells,) how often each cell is in an array."""
        return np.bincount(index.ravel(), minlength=len(self))

    def centers(self) -> Array:
        """(cells of one object, 3) middle of each cell, metres."""
        index = np.stack(np.unravel_index(np.arange(int(np.prod(self.shape))), self.shape), axis=-1)
        centers: Array = self._lower + (index + 0.5) * self.cell_size_m
        return centers


class TaskBins:
    """Bins of tasks, a task being a goal and a start, by what makes them hard for Bob.

    They are the goal's height, its distance from the object's start, and the gripper: it is free, it holds an object
    already, or, where a run blocks some grippers, it is blocked. Of several objects the highest and the furthest count,
    and the arrangement.

    Args:
        config: the run.
        layout: of its worlds' states.
    """

    def __init__(self, config: SelfPlayConfig, layout: StateLayout) -> None:
        self.world, self._success_distance_m = config.world, config.game.success_distance_m
        self.some_blocked = config.game.blocked_gripper_fraction > 0.0 or config.world.gripper == "blocked"
        self.obstacles = obstacle_columns(layout, len(config.world.obstacles))
        """Columns of a state that hold poses of obstacles."""
        self._contacts = layout["contacts"]
        self._gripper_blocked = layout["gripper_blocked"]  # columns that say so; none where worlds have no such flag

    def __len__(self) -> int:
        """Number of bins."""
        return NUM_TASK_BINS * (2 + self.some_blocked) * (NUM_ARRANGEMENTS if self.world.num_objects > 1 else 1)

    def index(self, goals: StateArray, start_positions: StateArray, start_states: StateArray) -> IntArray:
        """(M,) bin of each task: (M, 3 K) goal, (M, 3 K) positions of the objects and (M, S) state at the start."""
        heights = height_bins(highest(goals, self.world), self.world.rest_height_m)
        bins = heights * NUM_DISTANCE_BINS + distance_bins(goals, start_positions)
        kind: IntArray = self.held(start_states) + 2 * self.blocked(start_states).astype(np.int64)
        if self.world.num_objects > 1:
            kind = kind * NUM_ARRANGEMENTS + self.arrangements(goals, start_positions)
        return bins + kind * NUM_TASK_BINS

    def arrangements(self, goals: StateArray, starts: StateArray) -> IntArray:
        """(M,) arrangement of each of (M, 3 K) goals, beside (M, 3 K) places at the start."""
        several = (distances(goals, starts) > self._success_distance_m).sum(axis=1) > 1
        found: IntArray = np.where(several, SEVERAL_MOVED, ONE_MOVED)
        place, heights = each_object(goals), np.array(self.world.rest_heights_m)
        up_m, sideways_m = _STACKED_WITHIN_M
        for upper, lower in permutations(range(self.world.num_objects), 2):
            way = place[:, upper] - place[:, lower] - [0.0, 0.0, heights[upper] + heights[lower]]
            found[(np.abs(way[:, 2]) <= up_m) & (np.linalg.norm(way[:, :2], axis=1) <= sideways_m)] = STACKED
        return found

    def held(self, states: StateArray) -> BoolArray:
        """(M,) whether in (M, S) states a free gripper holds an object: both fingers touched it."""
        both: BoolArray = np.all(
            (states[:, self._contacts] > 0.0).reshape(len(states), self.world.num_objects, 2), axis=2
        )
        held: BoolArray = both.any(axis=1) & ~self.blocked(states)
        return held

    def blocked(self, states: StateArray) -> BoolArray:
        """(M,) whether the gripper of (M, S) states is blocked: of all worlds, or where the state says so."""
        blocked: BoolArray = np.any(states[:, self._gripper_blocked] > 0.0, axis=1)
        return blocked | (self.world.gripper == "blocked")
