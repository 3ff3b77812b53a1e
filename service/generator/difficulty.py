"""Difficulty of goals for the present Bob: his successes in bins of goals, and over a grid of cells."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from service.base.tensors import join_parts, split_parts
from service.base.types import Array, Arrays, BoolArray, IntArray, StateArray
from service.generator.bins import GoalCells

MEMORY_TRIES = 30.0
"""Tries that a rate remembers: each later try of the same bin takes one part in so many of a try's weight, whatever the
number of worlds."""
PROPOSAL_DECAY = 0.99
"""Weight that a proposal keeps from one record to the next: what was not proposed for long is new again."""
PRIOR_TRIES = 2.0
"""Beta(1, 1), uniform: one success and one failure are added to every bin, so an untried one has rate 1/2."""


class SuccessCounts:
    """Tries and successes of ``num_bins`` bins; the later a try, the more it weighs."""

    def __init__(self, num_bins: int) -> None:
        self.tries = np.zeros(num_bins)
        """(B,) decayed number of tries."""
        self.successes = np.zeros(num_bins)
        """(B,) decayed number of successes."""
        self.num_tries = np.zeros(num_bins, dtype=np.int64)
        """(B,) tries ever, not decayed."""

    def record(self, tries: IntArray, successes: IntArray) -> None:
        """Add (B,) tries and (B,) successes, which take weight from the earlier ones of their bins.

        The successes count as spread evenly over the tries, so it does not matter in how many parts these come.
        """
        kept = (1.0 - 1.0 / MEMORY_TRIES) ** tries
        added = (1.0 - kept) * MEMORY_TRIES  # the sum of the weights of so many tries
        self.tries = kept * self.tries + added
        self.successes = kept * self.successes + added * successes / np.maximum(tries, 1)
        self.num_tries += tries

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
        """Take over what ``state`` gave."""
        vars(self).update({name: np.array(state[name]) for name in vars(self)})


def novelty(proposals: StateArray) -> StateArray:
    """How rare proposals are: ``1 / sqrt(1 + n)`` of their decayed counts (as in Bellemare et al. 2016)."""
    rare: StateArray = 1.0 / np.sqrt(1.0 + proposals)
    return rare


class DifficultyGrid:
    """Bob's success over goal cells that cover the workspace.

    All rates remember the last tries (see ``MEMORY_TRIES``), so they follow Bob.
    """

    def __init__(self, cells: GoalCells) -> None:
        self.cells, self.counts = cells, SuccessCounts(len(cells))
        self.seen = np.zeros(len(cells), dtype=np.bool_)
        """(cells,) a valid goal was ever proposed there."""
        self.reached = np.zeros(len(cells), dtype=np.bool_)
        """(cells,) either player ever brought an object there in a game."""
        self.proposals = np.zeros(len(cells))
        """(cells,) decayed number of valid proposals, see ``PROPOSAL_DECAY``."""
        self.arranged = np.zeros(cells.num_arrangements)
        """(arrangements,) the same, where there are several objects."""

    @property
    def num_cells_seen(self) -> int:
        """Cells in which a valid goal was ever proposed."""
        return int(np.count_nonzero(self.seen))

    def record(
        self, proposed: IntArray, reached: IntArray, tries: IntArray, successes: IntArray, arranged: IntArray
    ) -> int:
        """Add what an iteration brought, and age the proposals by it.

        Args:
            proposed: (cells,) valid proposals, tried or not.
            reached: (cells,) steps after which an object was there.
            tries: (cells,) of the present Bob.
            successes: (cells,) of these tries.
            arranged: (arrangements,) valid proposals; none of one object.

        Returns:
            The number of cells in which a valid goal was proposed for the first time.
        """
        before = self.num_cells_seen
        self.seen |= proposed > 0
        self.reached |= reached > 0
        self.proposals = PROPOSAL_DECAY * self.proposals + proposed
        self.arranged = PROPOSAL_DECAY * self.arranged + arranged
        self.counts.record(tries, successes)
        return self.num_cells_seen - before

    @property
    def seen_by_object(self) -> BoolArray:
        """(K, cells of one object) whether a valid goal of it was ever proposed there."""
        return self.seen.reshape(self.cells.num_objects, -1)

    def near_reached(self) -> BoolArray:
        """(cells,) whether a cell was reached, or shares a face with one that was."""
        reached = self.reached.reshape(self.cells.num_objects, *self.cells.shape)
        near = reached.copy()
        for axis in range(1, reached.ndim):
            # Views in which this axis comes first: a change of ``towards`` is one of ``near``.
            towards, beside = np.moveaxis(near, axis, 0), np.moveaxis(reached, axis, 0)
            towards[1:] |= beside[:-1]
            towards[:-1] |= beside[1:]
        return near.ravel()

    def mean_success_rate(self) -> float:
        """Mean over all cells, 0 where no goal was proposed or tried: how much of the workspace Bob masters."""
        known = self.seen | (self.counts.num_tries > 0)
        return float(np.where(known, self.counts.success_rate(), 0.0).mean())

    def mean_learnability(self) -> float:
        """Mean over the cells seen; not-a-number while there are none."""
        return float(self.counts.learnability()[self.seen].mean()) if self.seen.any() else float("nan")

    def state(self) -> Arrays:
        """All counts, copied."""
        own = {"seen": self.seen.copy(), "proposals": self.proposals.copy(), "reached": self.reached.copy()}
        own |= {"arranged": self.arranged.copy()} if self.arranged.size else {}
        return own | join_parts({"cells": self.counts.state()})

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave."""
        self.seen, self.proposals = np.array(state["seen"]), np.array(state["proposals"])
        self.reached = np.array(state["reached"])
        self.arranged = np.array(state.get("arranged", self.arranged))
        self.counts.load_state(split_parts(state)["cells"])
