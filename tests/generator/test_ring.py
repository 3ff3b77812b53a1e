"""The newest rows, whatever was added."""

from __future__ import annotations

import numpy as np

from service.generator.ring import Ring, join_rows


def add(buffer: Ring, *numbers: int) -> None:
    column = np.array(numbers, dtype=np.float64)[:, np.newaxis]
    buffer.add(first=np.tile(column, 2), second=np.tile(column + 0.25, 3))


def make(capacity: int = 3, first: int = 2) -> Ring:
    return Ring(capacity, first=first, second=3)


def held(buffer: Ring) -> list[int]:
    return [int(row[0]) for row in buffer.rows()["second"]]


def test_ring_overwrites_the_oldest() -> None:
    buffer = make(3, 2)
    add(buffer, 1, 2)
    assert held(buffer) == [1, 2]
    add(buffer, 3, 4)
    assert held(buffer) == [4, 2, 3]
    assert len(buffer) == 3
    add(buffer, 5)
    assert held(buffer) == [4, 5, 3]
    buffer.add(first=np.zeros((0, 2)), second=np.zeros((0, 3)))
    assert held(buffer) == [4, 5, 3]


def test_more_goals_than_capacity_keep_the_newest() -> None:
    buffer = make(3, 2)
    add(buffer, 1)
    add(buffer, 2, 3, 4, 5, 6)
    assert sorted(held(buffer)) == [4, 5, 6]
    add(buffer, 7)
    assert sorted(held(buffer)) == [5, 6, 7]


def test_rows_are_copies_and_join_in_their_order() -> None:
    buffer = make(8)
    add(buffer, 1, 2, 3)
    rows = buffer.rows()
    np.testing.assert_array_equal(rows["second"][:, 0], rows["first"][:, 0] + 0.25)
    rows["first"][:] = 0.0
    assert held(buffer) == [1, 2, 3]
    joined = join_rows([buffer.rows(), {"first": np.full((1, 2), 9.0), "second": np.full((1, 3), 9.5)}])
    assert joined["first"][:, 0].tolist() == [1.0, 2.0, 3.0, 9.0]
    assert joined["second"][:, 2].tolist() == [1.25, 2.25, 3.25, 9.5]


def test_state_round_trip_continues_the_ring() -> None:
    for numbers in ((), (1, 2), (1, 2, 3), (1, 2, 3, 4)):
        buffer, copy = make(3, 2), make(3, 2)
        if numbers:
            add(buffer, *numbers)
        copy.load_state(buffer.state())
        for ring in (buffer, copy):
            add(ring, 8, 9)
        assert held(copy) == held(buffer)
