"""The goals of an iteration that a run keeps for people."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from service.generator.records import GOALS_PER_ITERATION, GoalRecords, sampled_goals
from service.generator.validity import Verdict

MakeRecords = Callable[..., GoalRecords]


def make(make_records: MakeRecords, num: int, **overrides: Any) -> GoalRecords:
    """N solved, valid, own goals."""
    positions = np.arange(3 * num, dtype=float).reshape(num, 3) / 1000
    fields = {"start_position": positions, "solved": np.ones(num, dtype=np.bool_)}
    return make_records(positions + 0.1, **fields | overrides)


def test_goals_are_start_goal_and_result(make_records: MakeRecords) -> None:
    goals = sampled_goals(make(make_records, 2, solved=[True, False]))
    assert np.round(goals, 4).tolist() == [
        [0.0, 0.001, 0.002, 0.1, 0.101, 0.102, 1.0],
        [0.003, 0.004, 0.005, 0.103, 0.104, 0.105, 0.0],
    ]


def test_only_goals_the_current_bob_played_himself(make_records: MakeRecords) -> None:
    records = make(
        make_records,
        5,
        verdict=[Verdict.VALID, Verdict.OUTSIDE, Verdict.VALID, Verdict.VALID, Verdict.VALID],
        played=[True, True, True, True, False],
        replayed=[False, False, True, False, False],
        bob_past=[False, False, False, True, False],
    )
    assert [goal[0] for goal in sampled_goals(records).tolist()] == [0.0]


def test_no_goals_and_very_many(make_records: MakeRecords) -> None:
    assert sampled_goals(make(make_records, 0)).shape == (0, 7)
    assert sampled_goals(make(make_records, 100)).shape == (GOALS_PER_ITERATION, 7)
