"""The newest rows of a few arrays of equal length, and how a checkpoint keeps them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from service.config import ConfigError
from service.generator.state import Array, State, take

Floats = NDArray[np.float64]


class Ring:
    """The last ``capacity`` rows added to named float columns.

    Args:
        capacity: rows held at most.
        **sizes: row length of each column.
    """

    def __init__(self, capacity: int, **sizes: int) -> None:
        self._columns = {name: np.zeros((capacity, size)) for name, size in sizes.items()}
        self._capacity = capacity
        self._size = 0
        self._next = 0

    def __len__(self) -> int:
        """Number of rows held."""
        return self._size

    def __getitem__(self, column: str) -> Floats:
        """(len, size) rows held, in the order that ``sample`` and its weights mean; a view."""
        return self._columns[column][: self._size]

    def add(self, **rows: Floats) -> None:
        """Add M rows to every column; the oldest are overwritten."""
        assert rows.keys() == self._columns.keys(), (rows.keys(), self._columns.keys())
        num = len(next(iter(rows.values())))
        where = (self._next + np.arange(num)[-self._capacity :]) % self._capacity
        for name, new in rows.items():
            self._columns[name][where] = new[-self._capacity :]
        self._next = (self._next + num) % self._capacity
        self._size = min(self._size + num, self._capacity)

    def sample(self, rng: np.random.Generator, num: int, weight: Floats | None = None) -> dict[str, Floats]:
        """Draw ``num`` whole rows with replacement, as copies.

        Args:
            rng: source of the draw.
            num: how many.
            weight: (len,) what each row's probability is proportional to; None for all alike.
        """
        assert self._size > 0, "sampled before anything was added"
        assert weight is None or weight.shape == (self._size,), (self._size, weight)
        rows = rng.choice(self._size, size=num, p=None if weight is None else weight / weight.sum())
        return {name: column[rows] for name, column in self._columns.items()}

    def state(self) -> State:
        """What is held, copied; rows never written are left out."""
        state: State = {name: self[name].copy() for name in self._columns}
        state["next"] = np.array([self._next])
        return state

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave.

        Raises:
            ConfigError: of a ring of another capacity or row length.
        """
        loaded = {name: take(state, name, column, any_rows=True) for name, column in self._columns.items()}
        size, written_next = len(next(iter(loaded.values()))), int(take(state, "next", np.zeros(1, dtype=np.int64))[0])
        # A ring is written next where it ends until it is full; the order of one of another capacity would be lost.
        if size > self._capacity or (size < self._capacity and written_next != size):
            raise ConfigError(
                f"generator state: {size} rows do not fit a buffer of {self._capacity} (generator.replay_buffer_size "
                "for goals); resume with the configuration of the checkpoint"
            )
        self._size, self._next = size, written_next % self._capacity
        for name, column in self._columns.items():
            column[: self._size] = loaded[name]
