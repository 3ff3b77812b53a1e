"""Difficulty of goals for the present Bob: his successes in bins of goals, and over a grid of cells."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from service.config import Point, WorldConfig
from service.generator.state import take
from service.io.tensors import join_parts, split_parts
from service.types import Array, Arrays, BoolArray, IntArray, StateArray

DECAY = 0.95
"""Weight that a try keeps from one record to the next: half after 13.5 iterations, so the rates follow Bob."""
PRIOR_TRIES = 2.0
"""Beta(1, 1), uniform: one success and one failure are added to every bin, so an untried one has rate 1/2."""
AIR_ABOVE_REST_M = 0.05
"""A goal is in the air when the object's centre is higher than it rests on the table by more than this."""
HEIGHT_EDGES_M = (0.10, 0.20)
"""Heights above the resting height that part low from middle and middle from high air goals."""
HEIGHT_NAMES = ("table", "low", "middle", "high")
DISTANCE_EDGES_M = (0.10, 0.15, 0.20, 0.30)
"""Distances from the start that part the distance bins."""


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
    distance = np.linalg.norm(goals - start_positions, axis=-1)
    bins: IntArray = np.digitize(distance, DISTANCE_EDGES_M).astype(np.int64)
    return bins


class SuccessCounts:
    """Exponentially decayed tries and successes of ``num_bins`` bins."""

    tries: StateArray
    """(B,) decayed number of tries."""
    successes: StateArray
    """(B,) decayed number of successes."""
    num_tries: IntArray
    """(B,) tries ever, not decayed."""

    def __init__(self, num_bins: int) -> None:
        self.tries = np.zeros(num_bins)
        self.successes = np.zeros(num_bins)
        self.num_tries = np.zeros(num_bins, dtype=np.int64)

    def record(self, bins: IntArray, solved: BoolArray) -> None:
        """Age all counts by one iteration, then add M tries at bins (M,) with results (M,)."""
        num_bins = self.tries.size
        counted = np.bincount(bins, minlength=num_bins)
        self.tries = DECAY * self.tries + counted
        self.successes = DECAY * self.successes + np.bincount(bins[solved], minlength=num_bins)
        self.num_tries += counted

    def success_rate(self) -> StateArray:
        """(B,) posterior mean (s + 1) / (n + 2) of the success probability."""
        return (self.successes + PRIOR_TRIES / 2) / (self.tries + PRIOR_TRIES)

    def learnability(self) -> StateArray:
        """(B,) p (1 - p) of the posterior mean (Rutherford et al. 2024); 1/4, the most, in an untried bin."""
        rate = self.success_rate()
        return rate * (1.0 - rate)

    def state(self) -> Arrays:
        """All counts, copied."""
        return {name: array.copy() for name, array in vars(self).items()}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave.

        Raises:
            ConfigError: another number of bins.
        """
        vars(self).update({name: take(state, name, like) for name, like in vars(self).items()})


class DifficultyGrid:
    """Bob's success over goal cells that cover the workspace.

    All rates are decayed running ones (see ``DECAY``), one ``record`` being one iteration, so they follow Bob.
    """

    bounds_m: tuple[Point, Point]
    """Lower and upper corner of the workspace, metres."""
    cell_size_m: float
    """Edge of a cell; the last ones may reach beyond the workspace."""
    shape: tuple[int, int, int]
    """Number of cells in x, y and z."""
    cells: SuccessCounts
    """Over the cells, x-major."""
    seen: BoolArray
    """(cells,) a valid goal was ever proposed there."""

    def __init__(self, world: WorldConfig, cell_size_m: float) -> None:
        self.bounds_m = world.workspace.lower_m, world.workspace.upper_m
        self._lower: StateArray = np.array(self.bounds_m[0])
        self.cell_size_m = cell_size_m
        # Rounding may not add a cell: 0.45 / 0.03 is a little over 15.
        counted = np.ceil((self.bounds_m[1] - self._lower) / cell_size_m - 1e-9).astype(int)
        self.shape = (int(counted[0]), int(counted[1]), int(counted[2]))
        num_cells = int(np.prod(self.shape))
        self.cells = SuccessCounts(num_cells)
        self.seen = np.zeros(num_cells, dtype=np.bool_)

    @property
    def num_cells_seen(self) -> int:
        """Cells in which a valid goal was ever proposed."""
        return int(np.count_nonzero(self.seen))

    def cell_index(self, goals: StateArray) -> IntArray:
        """(M,) flat cell of each of (M, 3) goals inside the workspace, metres; upper faces belong to the last cells."""
        index = np.floor((goals - self._lower) / self.cell_size_m).astype(np.int64)
        index = np.clip(index, 0, np.array(self.shape) - 1)
        return np.ravel_multi_index((index[:, 0], index[:, 1], index[:, 2]), self.shape).astype(np.int64)

    def mark_seen(self, goals: StateArray) -> int:
        """Note where (M, 3) valid goals were proposed, tried or not; returns how many cells were new."""
        before = self.num_cells_seen
        self.seen[self.cell_index(goals)] = True
        return self.num_cells_seen - before

    def record(self, goals: StateArray, solved: BoolArray) -> None:
        """Age all counts by one iteration, then add M tries of the present Bob.

        Args:
            goals: (M, 3) valid goals he played, metres.
            solved: (M,) whether he solved them.
        """
        self.mark_seen(goals)
        self.cells.record(self.cell_index(goals), solved)

    def learnability(self, goals: StateArray) -> StateArray:
        """(M,) p (1 - p) of the cell of each of (M, 3) goals; 1/4, the most, where untried."""
        learnability: StateArray = self.cells.learnability()[self.cell_index(goals)]
        return learnability

    def mean_learnability(self) -> float:
        """Mean over the cells seen; not-a-number while there are none."""
        return float(self.cells.learnability()[self.seen].mean()) if self.seen.any() else float("nan")

    def maps(self) -> dict[str, Array]:
        """Arrays over the cells for plots and REST: (X, Y, Z) each, and ``center`` (X, Y, Z, 3) in metres."""
        index = np.stack(np.meshgrid(*(np.arange(size) for size in self.shape), indexing="ij"), axis=-1)
        flat = {
            "seen": self.seen.copy(),
            "num_tries": self.cells.num_tries.copy(),
            "success_rate": self.cells.success_rate(),
            "learnability": self.cells.learnability(),
        }
        maps: dict[str, Array] = {name: array.reshape(self.shape) for name, array in flat.items()}
        maps["center"] = self._lower + (index + 0.5) * self.cell_size_m
        return maps

    def state(self) -> Arrays:
        """All counts, copied."""
        return {"seen": self.seen.copy()} | join_parts({"cells": self.cells.state()})

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave, of this or an older version, which also counted heights and distances.

        Raises:
            ConfigError: of a grid of another size.
        """
        self.seen = take(state, "seen", self.seen)
        self.cells.load_state(split_parts(state).get("cells", {}))
