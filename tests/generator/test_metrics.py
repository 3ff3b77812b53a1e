"""Metrics of one hand-written iteration."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from service.generator.records import GoalRecords, alice_metrics, bob_metrics
from service.generator.validity import Verdict

REST = 0.025


def test_six_worlds_by_hand(make_records: Callable[..., GoalRecords]) -> None:
    records = make_records(
        [
            (0.10, 0.0, 0.025),  # table, solved in 12 steps
            (0.0, 0.0, 0.225),  # air, failed
            (0.0, 0.1, 0.025),  # a past Alice's, solved
            (0.0, 0.0, 0.125),  # air, a past Bob failed
            (0.02, 0.0, 0.025),  # not moved, Bob replayed a table goal and solved it
            (0.5, 0.0, 0.025),  # outside, not played
        ],
        goal=[(0.1, 0, 0.025), (0, 0, 0.225), (0, 0.1, 0.025), (0, 0, 0.125), (0.1, 0.1, 0.025), (0.5, 0, 0.025)],
        verdict=np.array([0, 0, 0, 0, Verdict.NOT_MOVED, Verdict.OUTSIDE], dtype=np.int8),
        replayed=[False, False, False, False, True, False],
        played=[True, True, True, True, True, False],
        solved=[True, False, True, False, True, False],
        num_bob_steps=[12, 40, 7, 40, 9, 0],
        alice_past=[False, False, True, False, False, False],
        bob_past=[False, False, False, True, False, False],
    )
    # The current Alice proposed in 5 worlds, 3 of them valid: at 0.1, 0.2 and 0.1 m; heights 0.025, 0.225, 0.125.
    assert alice_metrics(records, REST) == pytest.approx(
        {
            "alice/valid_fraction": 3 / 5,
            "alice/not_moved_fraction": 1 / 5,
            "alice/outside_fraction": 1 / 5,
            "alice/fallen_fraction": 0.0,
            "alice/lifted_fraction": 2 / 3,
            "alice/goal_height_table_fraction": 1 / 3,
            "alice/goal_height_low_fraction": 1 / 3,
            "alice/goal_height_middle_fraction": 1 / 3,
            "alice/goal_height_high_fraction": 0.0,
            "alice/goal_distance_m": 0.4 / 3,
            "alice/goal_height_m": 0.125,
            "alice/goal_height_p90_m": 0.205,  # 0.125 + 0.8 x 0.1, between the upper two of three
        }
    )
    assert bob_metrics(records, REST) == pytest.approx(
        {
            "bob/success_rate": 1 / 2,
            "bob/success_rate_table": 1.0,
            "bob/success_rate_air": 0.0,
            "bob/success_rate_past_alice": 1.0,
            "bob/success_rate_replayed": 1.0,
            "bob/steps_to_success": 12.0,
        }
    )


def test_a_rate_over_no_cases_is_left_out(make_records: Callable[..., GoalRecords]) -> None:
    records = make_records([(0.0, 0.0, 0.025)], verdict=np.array([Verdict.NOT_MOVED], dtype=np.int8), played=[False])
    assert set(alice_metrics(records, REST)) == {f"alice/{kind.name.lower()}_fraction" for kind in Verdict}
    assert bob_metrics(records, REST) == {}
    assert alice_metrics(make_records([(0.1, 0.0, 0.025)], alice_past=[True]), REST) == {}


def test_distance_leaves_out_replaced_goals(make_records: Callable[..., GoalRecords]) -> None:
    records = make_records(
        [(0.1, 0.0, 0.025), (0.0, 0.2, 0.025)],
        start_position=[(0.0, 0.0, 0.025), (0.5, 0.5, 0.025)],  # the second start is the replayed goal's
        replayed=[False, True],
    )
    metrics = alice_metrics(records, REST)
    assert metrics["alice/goal_distance_m"] == pytest.approx(0.1)
    assert metrics["alice/valid_fraction"] == 1.0


def test_fallen_proposals_may_be_not_a_number(make_records: Callable[..., GoalRecords]) -> None:
    verdict = np.array([Verdict.FALLEN, Verdict.VALID], dtype=np.int8)
    records = make_records([(np.nan, 0.0, 0.0), (0.1, 0.0, 0.025)], verdict=verdict, played=[False, True])
    assert alice_metrics(records, REST)["alice/goal_height_m"] == 0.025
    assert alice_metrics(records, REST)["alice/fallen_fraction"] == 0.5
