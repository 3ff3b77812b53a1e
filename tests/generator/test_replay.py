"""The ring and its sampling."""

from __future__ import annotations

import numpy as np
import pytest

from service.config import ConfigError
from service.generator.replay import LEARNABILITY_FLOOR, GoalBuffer


def add(buffer: GoalBuffer, *numbers: int) -> None:
    column = np.array(numbers, dtype=np.float64)[:, np.newaxis]
    buffer.add(np.tile(column, 2), np.tile(column + 0.25, 3), np.tile(column + 0.5, 3))


def held(buffer: GoalBuffer) -> list[int]:
    return [int(goal[0]) for goal in buffer.goals]


def test_ring_overwrites_the_oldest() -> None:
    buffer = GoalBuffer(3, 2)
    add(buffer, 1, 2)
    assert held(buffer) == [1, 2]
    add(buffer, 3, 4)
    assert held(buffer) == [4, 2, 3]
    assert len(buffer) == 3
    add(buffer, 5)
    assert held(buffer) == [4, 5, 3]
    buffer.add(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3)))
    assert held(buffer) == [4, 5, 3]


def test_more_goals_than_capacity_keep_the_newest() -> None:
    buffer = GoalBuffer(3, 2)
    add(buffer, 1)
    add(buffer, 2, 3, 4, 5, 6)
    assert sorted(held(buffer)) == [4, 5, 6]
    add(buffer, 7)
    assert sorted(held(buffer)) == [5, 6, 7]


def test_sampled_rows_belong_together() -> None:
    buffer = GoalBuffer(8, 2)
    add(buffer, 1, 2, 3)
    drawn = buffer.sample(np.random.default_rng(0), 50, np.ones(3))
    assert drawn.start_state.shape == (50, 2)
    np.testing.assert_array_equal(drawn.start_position[:, 0], drawn.start_state[:, 0] + 0.25)
    np.testing.assert_array_equal(drawn.goal[:, 0], drawn.start_state[:, 0] + 0.5)
    assert set(drawn.start_state[:, 0]) == {1.0, 2.0, 3.0}


def test_sampling_is_proportional_to_learnability() -> None:
    buffer = GoalBuffer(8, 2)
    add(buffer, 0, 1, 2, 3)
    rate = np.array([0.5, 0.1, 0.9, 1.0])
    learnability = rate * (1 - rate)  # 0.25, 0.09, 0.09, 0
    num = 20_000
    drawn = buffer.sample(np.random.default_rng(3), num, learnability)
    counted = np.bincount(drawn.start_state[:, 0].astype(int), minlength=4)
    expected = num * (learnability + LEARNABILITY_FLOOR) / (0.43 + 4 * LEARNABILITY_FLOOR)
    chi_square = float(np.sum((counted - expected) ** 2 / expected))
    assert chi_square < 11.34, counted  # 99 % point of 3 degrees of freedom
    assert counted[3] > 0


def test_state_of_another_buffer_is_refused() -> None:
    full = GoalBuffer(3, 2)
    add(full, 1, 2, 3, 4)
    for capacity in (2, 5):
        with pytest.raises(ConfigError, match=f"3 goals do not fit generator.replay_buffer_size = {capacity}"):
            GoalBuffer(capacity, 2).load_state(full.state())
    with pytest.raises(ConfigError, match=r"'start_state' is float64 \(3, 2\)"):
        GoalBuffer(3, 5).load_state(full.state())


def test_state_round_trip_continues_the_ring() -> None:
    for numbers in ((), (1, 2), (1, 2, 3), (1, 2, 3, 4)):
        buffer, copy = GoalBuffer(3, 2), GoalBuffer(3, 2)
        if numbers:
            add(buffer, *numbers)
        copy.load_state(buffer.state())
        for ring in (buffer, copy):
            add(ring, 8, 9)
        assert held(copy) == held(buffer)
