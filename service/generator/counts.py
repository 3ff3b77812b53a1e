"""Tries and successes over bins, where old ones count less."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from service.generator.state import take
from service.types import Array, Arrays, BoolArray, IntArray, StateArray

DECAY = 0.95
"""Weight that a try keeps from one record to the next: half after 13.5 iterations, so the rates follow Bob."""
PRIOR_TRIES = 2.0
"""Beta(1, 1), uniform: one success and one failure are added to every bin, so an untried one has rate 1/2."""


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
        return {"tries": self.tries.copy(), "successes": self.successes.copy(), "num_tries": self.num_tries.copy()}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave.

        Raises:
            ConfigError: another number of bins.
        """
        loaded = {name: take(state, name, like) for name, like in self.state().items()}
        self.tries, self.successes, self.num_tries = loaded["tries"], loaded["successes"], loaded["num_tries"]
