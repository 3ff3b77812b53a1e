"""Earlier valid goals, to be played again where Bob can learn most from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.config import ConfigError
from service.generator.state import Array, State, take

Floats = NDArray[np.float64]

LEARNABILITY_FLOOR = 0.01
"""Added to p (1 - p), which is at most 1/4, so goals of a solved or hopeless cell stay drawable and measured."""


class StoredGoals(NamedTuple):
    """M goals, each with the state it was proposed from."""

    start_state: Floats
    """(M, S) full physics state."""
    start_position: Floats
    """(M, 3) object position in it, metres."""
    goal: Floats
    """(M, 3) metres."""


class GoalBuffer:
    """Ring of the last ``capacity`` goals; sampled in proportion to learnability (Rutherford et al. 2024)."""

    def __init__(self, capacity: int, state_size: int) -> None:
        self._goals = StoredGoals(np.zeros((capacity, state_size)), np.zeros((capacity, 3)), np.zeros((capacity, 3)))
        self._size = 0
        self._next = 0

    def __len__(self) -> int:
        """Number of goals held."""
        return self._size

    @property
    def goals(self) -> Floats:
        """(len, 3) goals held, metres, in the order ``sample`` expects their learnability; a view."""
        return self._goals.goal[: self._size]

    def add(self, start_state: Floats, start_position: Floats, goal: Floats) -> None:
        """Add M goals, (M, S), (M, 3) and (M, 3); the oldest are overwritten."""
        capacity = len(self._goals.goal)
        num = len(goal)
        rows = (self._next + np.arange(num)[-capacity:]) % capacity
        for store, new in zip(self._goals, (start_state, start_position, goal), strict=True):
            store[rows] = new[-capacity:]
        self._next = (self._next + num) % capacity
        self._size = min(self._size + num, capacity)

    def sample(self, rng: np.random.Generator, num: int, learnability: Floats) -> StoredGoals:
        """Draw ``num`` goals, with replacement.

        Args:
            rng: source of the draw.
            num: how many.
            learnability: (len,) of each of ``goals``; its probability is proportional to it plus a small floor.
        """
        assert self._size > 0, "sampled before any goal was added"
        assert learnability.shape == (self._size,), (self._size, learnability.shape)
        weight = learnability + LEARNABILITY_FLOOR
        rows = rng.choice(self._size, size=num, p=weight / weight.sum())
        return StoredGoals(*(store[rows] for store in self._goals))

    def state(self) -> State:
        """What is held, copied; rows never written are left out."""
        state: State = {name: store[: self._size].copy() for name, store in self._goals._asdict().items()}
        state["next"] = np.array([self._next])
        return state

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave.

        Raises:
            ConfigError: of a buffer of another capacity or state size.
        """
        capacity = len(self._goals.goal)
        loaded = {name: take(state, name, store, any_rows=True) for name, store in self._goals._asdict().items()}
        size, written_next = len(loaded["goal"]), int(take(state, "next", np.zeros(1, dtype=np.int64))[0])
        # A ring is written next where it ends until it is full; the order of one of another capacity would be lost.
        if size > capacity or (size < capacity and written_next != size):
            raise ConfigError(
                f"generator state: {size} goals do not fit generator.replay_buffer_size = {capacity}; "
                "resume with the configuration of the checkpoint"
            )
        self._size, self._next = size, written_next % capacity
        for name, store in self._goals._asdict().items():
            store[: self._size] = loaded[name]
