"""Replay buffer of many worlds that step together, with hindsight: goals of which the object came there later.

A row is one step of every world. Columns are float32 arrays by name, whatever the learner wants to see again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.base.types import Array, Arrays, BoolArray, FloatArray

Columns = dict[str, FloatArray]
_LAST_STEP = "last_step"
_GOES_ON = np.iinfo(np.int32).max


class Indices(NamedTuple):
    """Transitions in a buffer."""

    step: NDArray[np.int64]
    """(B,) numbers of their steps, counted from the first that was ever added."""
    world: NDArray[np.int64]
    """(B,)"""


class ReplayBuffer:
    """The newest transitions of N worlds, at most ``num_steps`` of each.

    Args:
        num_steps: that are kept; older ones are overwritten.
        num_worlds: N.
        columns: sizes by name.
    """

    def __init__(self, num_steps: int, num_worlds: int, columns: Mapping[str, int]) -> None:
        self.num_steps, self.num_worlds = num_steps, num_worlds
        self.num_added = 0
        """Steps added so far, overwritten ones among them."""
        self._first = 0
        """Number of the first step that this buffer ever had: a larger one does not have all that came before it."""
        self._columns = {name: np.zeros((num_steps, num_worlds, size), np.float32) for name, size in columns.items()}
        self._last_step = np.full((num_steps, num_worlds), _GOES_ON, dtype=np.int32)  # of each transition's episode
        self._began = np.zeros(num_worlds, dtype=np.int64)

    def add(self, columns: Mapping[str, FloatArray], ended: BoolArray) -> None:
        """Add a step of every world.

        Args:
            columns: (N, size) each.
            ended: (N,) whether it was the last step of the world's episode.
        """
        assert columns.keys() == self._columns.keys()
        row = self.num_added % self.num_steps
        for name, values in columns.items():
            self._columns[name][row] = values
        self._last_step[row] = _GOES_ON
        for world in np.flatnonzero(ended):
            steps = np.arange(max(self._began[world], self.num_added + 1 - self.num_steps), self.num_added + 1)
            self._last_step[steps % self.num_steps, world] = self.num_added
            self._began[world] = self.num_added + 1
        self.num_added += 1

    def draw(self, size: int, rng: np.random.Generator, *, newest: int | None = None) -> Indices:
        """Draw ``size`` transitions, all alike, with replacement; of the newest steps of every world, or of all."""
        kept = self.num_steps if newest is None else min(self.num_steps, newest)
        oldest = max(self._first, self.num_added - kept)
        flat = rng.integers(oldest * self.num_worlds, self.num_added * self.num_worlds, size)
        return Indices(*np.divmod(flat, self.num_worlds))

    def draw_later(self, places: Indices, rng: np.random.Generator) -> Indices:
        """Draw for each place one of the same episode, not before it, all alike ("future", Andrychowicz et al. 2017).

        Of an episode that goes on, what there is so far.
        """
        last = np.minimum(self._last_step[places.step % self.num_steps, places.world], self.num_added - 1)
        return Indices(rng.integers(places.step, last + 1), places.world)

    def read(self, places: Indices) -> Columns:
        """Copies of all columns there, (B, size) each."""
        rows = (places.step % self.num_steps, places.world)
        return {name: values[rows] for name, values in self._columns.items()}

    def column(self, name: str, places: Indices) -> FloatArray:
        """A copy of one column there, (B, size)."""
        values: FloatArray = self._columns[name][places.step % self.num_steps, places.world]
        return values

    def state(self) -> Arrays:
        """Everything a new buffer continues from, as arrays by name; rows that are not in use are left out."""
        used = min(self.num_added, self.num_steps)
        rows = {name: values[:used].copy() for name, values in self._columns.items()}
        counted = {"num_added": np.array(self.num_added), "first": np.array(self._first), "began": self._began.copy()}
        return {**rows, _LAST_STEP: self._last_step[:used].copy(), **counted}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Continue from a buffer of as many worlds, with what fits of its newest steps."""
        self.num_added, self._began = int(state["num_added"]), np.array(state["began"], dtype=np.int64)
        num_saved = len(state[_LAST_STEP])
        # states of before 28 November have no "first"
        self._first = max(int(state.get("first", 0)), self.num_added - min(num_saved, self.num_steps))
        newest = np.arange(self.num_added - min(num_saved, self.num_steps), self.num_added)
        for name, values in {**self._columns, _LAST_STEP: self._last_step}.items():
            values[newest % self.num_steps] = state[name][newest % max(num_saved, 1)]
