"""Ring buffer: the newest rows of a few arrays of equal length."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from service.base.types import Array, Arrays, StateArray

Rows = dict[str, StateArray]
"""Named columns of equally many rows."""


def join_rows(parts: Sequence[Rows]) -> Rows:
    """All rows of several parts with the same columns, in their order."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


class Ring:
    """The last rows added to named float columns.

    Args:
        capacity: rows held at most.
        **sizes: row length of each column.
    """

    def __init__(self, capacity: int, **sizes: int) -> None:
        self._capacity, self._num_added = capacity, 0
        self._columns = {name: np.zeros((capacity, size)) for name, size in sizes.items()}

    def __len__(self) -> int:
        """Number of rows held."""
        return min(self._num_added, self._capacity)

    def rows(self) -> Rows:
        """(len, size) rows held of each column; copies."""
        return {name: column[: len(self)].copy() for name, column in self._columns.items()}

    def add(self, **rows: StateArray) -> None:
        """Add (M, size) rows to every column; the oldest are overwritten."""
        assert rows.keys() == self._columns.keys(), (rows.keys(), self._columns.keys())
        num = len(next(iter(rows.values())))
        newest = slice(max(0, num - self._capacity), num)  # of more than there is room for
        where = (self._num_added + np.arange(num)[newest]) % self._capacity
        for name, new in rows.items():
            self._columns[name][where] = new[newest]
        self._num_added += num

    def state(self) -> Arrays:
        """Everything held, copied; rows never written are left out."""
        return {**self.rows(), "num_added": np.array(self._num_added)}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave."""
        self._num_added = int(state["num_added"])
        for name, column in self._columns.items():
            column[: len(self)] = state[name]
