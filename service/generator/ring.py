"""Ring buffer: the newest rows of a few arrays of equal length."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from service.base.types import Array, Arrays, IntArray, StateArray

Rows = dict[str, StateArray]
"""Named columns of equally many rows."""


def join_rows(parts: Sequence[Rows]) -> Rows:
    """All rows of several parts with the same columns, in their order."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


class Ring:
    """The last rows added to named float columns; no part may hold more than its share.

    Args:
        capacity: rows held at most, all parts together; each part has an equal share, at least one.
        num_parts: kinds of rows.
        **sizes: row length of each column.
    """

    def __init__(self, capacity: int, num_parts: int = 1, **sizes: int) -> None:
        self._share = max(1, capacity // num_parts)
        self._columns = {name: np.zeros((num_parts * self._share, size)) for name, size in sizes.items()}
        self._num_added = np.zeros(num_parts, dtype=np.int64)

    def __len__(self) -> int:
        """Number of rows held."""
        return int(self._num_held.sum())

    def rows(self) -> Rows:
        """(len, size) rows held of each column, in the order of ``part_share``; copies."""
        held = self._held
        return {name: column[held] for name, column in self._columns.items()}

    def add(self, part: IntArray | None = None, **rows: StateArray) -> None:
        """Add M rows to every column; the oldest of their part are overwritten.

        Args:
            part: (M,) which part each belongs to; None where there is but one.
            **rows: (M, size) each.
        """
        assert rows.keys() == self._columns.keys(), (rows.keys(), self._columns.keys())
        num = len(next(iter(rows.values())))
        part = np.zeros(num, dtype=np.int64) if part is None else part
        order = np.argsort(part, kind="stable")  # part by part, oldest first
        counted = np.bincount(part, minlength=self._num_added.size)
        # Number of each new row within its part, counted from 0.
        rank = np.arange(num) - np.repeat(np.cumsum(counted) - counted, counted)
        own = part[order]
        # Of more new rows than a part has room for, only the newest are written: each place is written once.
        newest = rank >= counted[own] - self._share
        where = own * self._share + (self._num_added[own] + rank) % self._share
        for name, new in rows.items():
            self._columns[name][where[newest]] = new[order[newest]]
        self._num_added += counted

    def part_share(self) -> StateArray:
        """(len,) weights that make all parts equally likely: one over the rows held of each row's part."""
        num = self._num_held
        share: StateArray = 1.0 / np.repeat(num, num)
        return share

    def state(self) -> Arrays:
        """Everything held, copied; rows never written are left out."""
        state: Arrays = dict(self.rows())
        state["num_added"] = self._num_added.copy()
        return state

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave."""
        self._num_added = np.array(state["num_added"])
        for name, column in self._columns.items():
            column[self._held] = state[name]

    @property
    def _num_held(self) -> IntArray:
        return np.minimum(self._num_added, self._share)

    @property
    def _held(self) -> IntArray:
        """Places that have been written, part by part."""
        return np.flatnonzero(np.arange(self._share) < self._num_held[:, None])
