"""Metrics of one hand-written iteration."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from service.base.types import Metrics
from service.generator.records import (
    GoalRecords,
    alice_sums,
    bob_sums,
    count_heights,
    height_percentile,
    means,
)
from service.generator.validity import Verdict

REST = 0.025


def alice_metrics(records: GoalRecords) -> Metrics:
    return means(alice_sums(records, REST))


def bob_metrics(records: GoalRecords) -> Metrics:
    return means(bob_sums(records, REST))


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
    assert alice_metrics(records) == pytest.approx(
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
        }
    )
    assert bob_metrics(records) == pytest.approx(
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
    assert set(alice_metrics(records)) == {f"alice/{kind.name.lower()}_fraction" for kind in Verdict}
    assert bob_metrics(records) == {}
    assert alice_metrics(make_records([(0.1, 0.0, 0.025)], alice_past=[True])) == {}


def test_distance_leaves_out_replaced_goals(make_records: Callable[..., GoalRecords]) -> None:
    records = make_records(
        [(0.1, 0.0, 0.025), (0.0, 0.2, 0.025)],
        start_position=[(0.0, 0.0, 0.025), (0.5, 0.5, 0.025)],  # the second start is the replayed goal's
        replayed=[False, True],
    )
    metrics = alice_metrics(records)
    assert metrics["alice/goal_distance_m"] == pytest.approx(0.1)
    assert metrics["alice/valid_fraction"] == 1.0


def test_fallen_proposals_may_be_not_a_number(make_records: Callable[..., GoalRecords]) -> None:
    verdict = np.array([Verdict.FALLEN, Verdict.VALID], dtype=np.int8)
    records = make_records([(np.nan, 0.0, 0.0), (0.1, 0.0, 0.025)], verdict=verdict, played=[False, True])
    assert alice_metrics(records)["alice/goal_height_m"] == 0.025
    assert alice_metrics(records)["alice/fallen_fraction"] == 0.5


def test_the_height_up_to_which_nine_of_ten_lie(make_records: Callable[..., GoalRecords]) -> None:
    heights = [0.0254, *[0.1003] * 8, 0.2996]  # nine of ten are no higher than 0.1003
    records = make_records([(0.1, 0.0, height) for height in heights])
    counted = count_heights(records)
    assert {int(step): int(counted[step]) for step in np.flatnonzero(counted)} == {25: 1, 100: 8, 299: 1}
    assert height_percentile(counted, 90.0) == pytest.approx(0.1005)  # the middle of its millimetre
    assert height_percentile(counted, 91.0) == pytest.approx(0.2995)
    assert np.isnan(height_percentile(count_heights(make_records([])), 90.0))
    past = make_records([(0.1, 0.0, 0.2)] * 2, alice_past=[True, False], verdict=np.array([0, 1], dtype=np.int8))
    assert not count_heights(past).any()
    # the upper face of the highest workspace there may be, and what is nowhere in it
    outermost = count_heights(make_records([(0.0, 0.0, 0.8), (0.0, 0.0, 0.9), (0.0, 0.0, -0.1)]))
    assert np.flatnonzero(outermost).tolist() == [0, 800]
    assert len(outermost) == 801
