"""Which goals of an iteration a run keeps for people."""

from types import SimpleNamespace

import numpy as np

from service.generator.validity import Verdict
from service.runtime.workers import GOALS_PER_ITERATION, sampled_goals


def make_records(num, **overrides):
    """What ``sampled_goals`` reads of N solved, valid, own goals."""
    positions = np.arange(3 * num, dtype=float).reshape(num, 3) / 1000
    fields = {
        "start_position": positions,
        "goal": positions + 0.1,
        "solved": np.ones(num, dtype=bool),
        "verdict": np.full(num, Verdict.VALID),
        "played": np.ones(num, dtype=bool),
        "replayed": np.zeros(num, dtype=bool),
        "bob_past": np.zeros(num, dtype=bool),
    }
    return SimpleNamespace(**fields | {name: np.array(value) for name, value in overrides.items()})


def test_goals_are_start_goal_and_result():
    goals = sampled_goals(make_records(2, solved=[True, False]))
    assert np.round(goals, 4).tolist() == [
        [0.0, 0.001, 0.002, 0.1, 0.101, 0.102, 1.0],
        [0.003, 0.004, 0.005, 0.103, 0.104, 0.105, 0.0],
    ]


def test_only_goals_the_current_bob_played_himself():
    records = make_records(
        5,
        verdict=[Verdict.VALID, Verdict.OUTSIDE, Verdict.VALID, Verdict.VALID, Verdict.VALID],
        played=[True, True, True, True, False],
        replayed=[False, False, True, False, False],
        bob_past=[False, False, False, True, False],
    )
    assert [goal[0] for goal in sampled_goals(records).tolist()] == [0.0]


def test_no_goals_and_very_many():
    assert sampled_goals(make_records(0)).shape == (0, 7)
    assert sampled_goals(make_records(100)).shape == (GOALS_PER_ITERATION, 7)
