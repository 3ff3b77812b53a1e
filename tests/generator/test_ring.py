"""The ring and its sampling."""

from __future__ import annotations

import numpy as np
import pytest

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


def test_every_part_keeps_its_newest_rows() -> None:
    buffer = Ring(6, 3, first=1)  # two each
    for part, number in ((0, 1), (0, 2), (2, 3), (0, 4)):
        buffer.add(np.array([part]), first=np.array([[float(number)]]))
    assert buffer.rows()["first"].ravel().tolist() == [4, 2, 3]
    assert buffer.part_share().tolist() == [0.5, 0.5, 1.0]
    buffer.add(np.array([1, 2, 2, 2, 1]), first=np.arange(5.0, 10.0)[:, None])  # 3 of part 2 at once: 5 is too old
    assert sorted(buffer.rows()["first"].ravel().tolist()) == [2, 4, 5, 7, 8, 9]
    assert buffer.rows()["first"][2:4].ravel().tolist() == [5, 9]
    copy = Ring(6, 3, first=1)
    copy.load_state(buffer.state())
    for ring in (buffer, copy):
        ring.add(np.array([2, 0]), first=np.array([[10.0], [11.0]]))
    assert copy.rows()["first"].tolist() == buffer.rows()["first"].tolist()
    assert sorted(buffer.rows()["first"][4:].ravel().tolist()) == [8, 10]


def test_the_shares_make_all_parts_equally_likely() -> None:
    buffer = Ring(40, 2, first=1)
    buffer.add(np.repeat([0, 1], [19, 1]), first=np.repeat([[0.0], [1.0]], [19, 1], axis=0))
    share = buffer.part_share()
    assert share.sum() == pytest.approx(2.0)
    assert np.average(buffer.rows()["first"].ravel(), weights=share) == pytest.approx(0.5)


def test_state_round_trip_continues_the_ring() -> None:
    for numbers in ((), (1, 2), (1, 2, 3), (1, 2, 3, 4)):
        buffer, copy = make(3, 2), make(3, 2)
        if numbers:
            add(buffer, *numbers)
        copy.load_state(buffer.state())
        for ring in (buffer, copy):
            add(ring, 8, 9)
        assert held(copy) == held(buffer)
