"""Shares of three ranks, by hand."""

import numpy as np
import pytest

from service.learner.group import ALONE
from service.learner.shares import Share, join_states, own_demonstrations, share_of, share_out


class Third:
    """The group as rank ``rank`` of three sees it, where all have said what they have."""

    size = 3

    def __init__(self, rank, *everyones):
        self.rank, self._everyones = rank, [np.array(each, dtype=np.int64) for each in everyones]

    def gather(self, numbers):
        np.testing.assert_array_equal(numbers, self._everyones[self.rank])
        return self._everyones


def test_blocks_of_several_ranks_are_joined_one_after_the_other():
    # First blocks: rows 0 1 of rank 0, none of rank 1, row 2 of rank 2. Second: 3 of rank 0, 4 5 of rank 1. Third: 6.
    everyones = [2, 1], [0, 2, 1], [1]
    places = [[0, 1, 3], [4, 5, 6], [2]]
    for rank in range(3):
        share = share_of(np.array(everyones[rank]), Third(rank, *everyones))
        assert share.places.tolist() == places[rank]
        assert share.total == 7
    assert share_of(np.array([2, 1]), ALONE) is None


def test_a_rank_without_rows_has_a_share_of_none():
    share = share_of(np.zeros(0, dtype=np.int64), Third(1, [2], [], [3]))
    assert share.places.tolist() == []
    rows, drawn = share.find(np.array([4, 0, 2]))
    assert (rows.tolist(), drawn.places.tolist(), drawn.total) == ([], [], 3)


def test_own_rows_are_found_among_drawn_places():
    share = Share(np.array([1, 4, 6]), 8)
    rows, drawn = share.find(np.array([6, 0, 1, 7, 1, 5]))
    assert rows.tolist() == [2, 0, 0]
    assert (drawn.places.tolist(), drawn.total) == ([0, 2, 4], 6)


def test_reflections_come_behind_the_rows_of_all_ranks():
    share = Share(np.array([1, 4]), 5).mirrored()
    assert (share.places.tolist(), share.total) == ([1, 4, 6, 9], 10)


@pytest.mark.parametrize(("num", "shares"), [(7, [2, 2, 3]), (2, [0, 1, 1]), (0, [0, 0, 0])])
def test_items_are_shared_out_among_neighbours(num, shares):
    parts = [list(share_out(range(num), rank, 3)) for rank in range(3)]
    assert [item for part in parts for item in part] == list(range(num))
    assert [len(part) for part in parts] == shares


def test_shares_of_a_state_join_to_the_whole():
    steps = np.arange(11, dtype=np.float32)[:, None]
    whole = {"observation": steps, "action": -steps, "num_steps": np.array([4, 0, 7])}
    own = [own_demonstrations(whole, rank, 3) for rank in range(3)]
    assert own[0]["observation"].ravel().tolist() == [0, 4, 5]
    assert [each["num_steps"].tolist() for each in own] == [[1, 0, 2], [1, 0, 2], [2, 0, 3]]
    states = [{f"demonstrations/{name}": array for name, array in each.items()} for each in own]
    states[0] |= {"version": np.array(3), "window/0001/0000/reward": np.array([1.0])}
    states[1] |= {"window/0000/0000/reward": np.array([2.0]), "window/0001/0000/reward": np.array([3.0])}
    states[2] |= {"window/0001/0000/reward": np.array([4.0]), "window/0001/0001/reward": np.array([5.0])}
    joined = join_states(states)
    for name, array in whole.items():
        np.testing.assert_array_equal(joined.pop(f"demonstrations/{name}"), array)
    assert {name: array.tolist() for name, array in joined.items()} == {
        "version": 3,
        "window/0000/0000/reward": [2.0],
        "window/0001/0000/reward": [1.0],
        "window/0001/0001/reward": [3.0],
        "window/0001/0002/reward": [4.0],
        "window/0001/0003/reward": [5.0],
    }
