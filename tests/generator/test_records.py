"""Metrics by hand, the goals that a run keeps, and the summary of a round: sums that add up, and a bounded sample."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from service.base.types import Metrics
from service.config import parse_config
from service.envs.scene import build_layout
from service.generator.bins import NUM_TASK_BINS, GoalCells, TaskBins
from service.generator.generator import TaskGenerator
from service.generator.records import (
    GOALS_PER_ITERATION,
    GoalRecords,
    GoalSummary,
    alice_sums,
    bob_sums,
    count_heights,
    height_p90_m,
    join_summaries,
    means,
    sampled_goals,
    summarize,
)
from service.generator.ring import Rows
from service.generator.validity import Verdict
from tests.generator.outcomes import SOME_BLOCKED, make_records, make_starts, make_states, summary_of

CONFIG = parse_config({"game": {"blocked_gripper_fraction": 0.2}}, where="test")
CELLS, TASKS = GoalCells(CONFIG.world, CONFIG.generator.cell_size_m), TaskBins(CONFIG, SOME_BLOCKED)
WORLD = CONFIG.world


def alice_metrics(records: GoalRecords) -> Metrics:
    return means(alice_sums(records, WORLD))


def bob_metrics(records: GoalRecords) -> Metrics:
    return means(bob_sums(records, WORLD))


def test_metrics_of_six_worlds_by_hand() -> None:
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


def test_a_rate_over_no_cases_is_left_out() -> None:
    records = make_records([(0.0, 0.0, 0.025)], verdict=np.array([Verdict.NOT_MOVED], dtype=np.int8), played=[False])
    assert set(alice_metrics(records)) == {f"alice/{kind.name.lower()}_fraction" for kind in Verdict}
    assert bob_metrics(records) == {}
    assert alice_metrics(make_records([(0.1, 0.0, 0.025)], alice_past=[True])) == {}


def test_distance_leaves_out_replaced_goals() -> None:
    records = make_records(
        [(0.1, 0.0, 0.025), (0.0, 0.2, 0.025)],
        start_position=[(0.0, 0.0, 0.025), (0.5, 0.5, 0.025)],  # the second start is the replayed goal's
        replayed=[False, True],
    )
    metrics = alice_metrics(records)
    assert metrics["alice/goal_distance_m"] == pytest.approx(0.1)
    assert metrics["alice/valid_fraction"] == 1.0


def test_fallen_proposals_may_be_not_a_number() -> None:
    verdict = np.array([Verdict.FALLEN, Verdict.VALID], dtype=np.int8)
    records = make_records([(np.nan, 0.0, 0.0), (0.1, 0.0, 0.025)], verdict=verdict, played=[False, True])
    assert alice_metrics(records)["alice/goal_height_m"] == 0.025
    assert alice_metrics(records)["alice/fallen_fraction"] == 0.5


def test_the_height_up_to_which_nine_of_ten_lie() -> None:
    heights = [0.0254, *[0.1003] * 8, 0.2996]  # nine of ten are no higher than 0.1003
    records = make_records([(0.1, 0.0, height) for height in heights])
    counted = count_heights(records, WORLD)
    assert {int(step): int(counted[step]) for step in np.flatnonzero(counted)} == {25: 1, 100: 8, 299: 1}
    assert height_p90_m(counted) == pytest.approx(0.1005)  # the middle of its millimetre
    counted[299] += 1  # nine of eleven are too few
    assert height_p90_m(counted) == pytest.approx(0.2995)
    assert np.isnan(height_p90_m(count_heights(make_records([]), WORLD)))
    past = make_records([(0.1, 0.0, 0.2)] * 2, alice_past=[True, False], verdict=np.array([0, 1], dtype=np.int8))
    assert not count_heights(past, WORLD).any()
    # the upper face of the highest workspace there may be, and what is nowhere in it
    outermost = count_heights(make_records([(0.0, 0.0, 0.8), (0.0, 0.0, 0.9), (0.0, 0.0, -0.1)]), WORLD)
    assert np.flatnonzero(outermost).tolist() == [0, 800]
    assert len(outermost) == 801


def own_goals(num: int, **overrides: Any) -> GoalRecords:
    """N solved, valid, own goals."""
    positions = np.arange(3 * num, dtype=float).reshape(num, 3) / 1000
    fields = {"start_position": positions, "solved": np.ones(num, dtype=np.bool_)}
    return make_records(positions + 0.1, **fields | overrides)


def test_goals_are_start_goal_and_result() -> None:
    goals = sampled_goals(own_goals(2, solved=[True, False]))
    assert np.round(goals, 4).tolist() == [
        [0.0, 0.001, 0.002, 0.1, 0.101, 0.102, 1.0],
        [0.003, 0.004, 0.005, 0.103, 0.104, 0.105, 0.0],
    ]


def test_only_goals_the_current_bob_played_himself() -> None:
    records = own_goals(
        5,
        verdict=[Verdict.VALID, Verdict.OUTSIDE, Verdict.VALID, Verdict.VALID, Verdict.VALID],
        played=[True, True, True, True, False],
        replayed=[False, False, True, False, False],
        bob_past=[False, False, False, True, False],
    )
    assert [goal[0] for goal in sampled_goals(records).tolist()] == [0.0]


def test_no_goals_and_very_many() -> None:
    assert sampled_goals(own_goals(0)).shape == (0, 7)
    assert sampled_goals(own_goals(100)).shape == (GOALS_PER_ITERATION, 7)


def at(*goals: tuple[float, ...]) -> list[int]:
    """Cells of goals."""
    return CELLS.index(np.array(goals)).ravel().tolist()


def counted(counts: np.ndarray) -> dict[int, int]:
    """Bins that are not empty."""
    return {int(index): int(counts[index]) for index in np.flatnonzero(counts)}


def test_summary_of_six_worlds_by_hand() -> None:
    near, far, other = (-0.1, 0.0, 0.025), (0.1, 0.0, 0.225), (-0.2, 0.1, 0.025)
    records = make_records(
        [near, near, far, other, far, (0.5, 0.0, 0.0)],
        goal=[near, near, far, near, other, near],
        start_state=make_states(6, SOME_BLOCKED, blocked=np.arange(6) == 3),
        # Solved as proposed; a past Bob's; diverged; from a reset, blocked; replayed from its own start; from a reset.
        verdict=np.array([0, 0, 0, 0, 0, Verdict.OUTSIDE], dtype=np.int8),
        replayed=[False, False, False, True, True, True],
        from_reset=[True, False, False, True, False, True],
        played=[True, True, False, True, True, True],
        solved=[True, True, False, False, True, True],
        bob_past=[False, True, False, False, False, False],
    )
    summary = summary_of(records, CELLS, TASKS)
    assert counted(summary.proposed) == dict(zip(at(near, far, other), (2, 2, 1), strict=True))
    assert counted(summary.tries) == dict.fromkeys(at(near, other), 1)
    assert counted(summary.successes) == dict.fromkeys(at(near, other), 1)
    bin_of_near, bin_of_other = 1, 3  # on the table, 0.10 m and 0.22 m away
    assert counted(summary.task_tries) == {bin_of_near: 2, bin_of_other: 1, bin_of_near + 2 * NUM_TASK_BINS: 1}
    assert counted(summary.task_successes) == {bin_of_near: 2, bin_of_other: 1}
    assert summary.goals["goal"].tolist() == [list(near), list(near)]
    assert summary.shown.shape == (1, 7)
    assert summary.metrics["bob/success_rate"] == (1, 1.0)
    assert summary.metrics["bob/success_rate_from_reset"] == (3, 2.0)
    assert summary.metrics["bob/success_rate_blocked"] == (1, 0.0)
    assert summary.metrics["alice/valid_fraction"] == (6, 5.0)
    assert summary.heights.sum() == 5


def test_every_try_of_the_current_bob_counts_as_a_task() -> None:
    """Of the same goal as proposed, replayed, and replayed from a reset; from the hand it is another one."""
    goal = (-0.1, 0.0, 0.025)
    records = make_records(
        [goal] * 6,
        start_state=make_states(6, SOME_BLOCKED, held=np.arange(6) >= 4),
        replayed=[False, True, True, False, False, True],
        from_reset=[False, False, True, False, False, False],
        played=[True, True, True, False, True, True],
        solved=[True, False, True, False, False, True],
    )
    summary = summary_of(records, CELLS, TASKS)
    assert counted(summary.task_tries) == {1: 3, 1 + NUM_TASK_BINS: 2}
    assert counted(summary.task_successes) == {1: 2, 1 + NUM_TASK_BINS: 1}
    assert counted(summary.tries) == dict.fromkeys(at(goal), 4)  # cells leave out what was replayed from a reset


def marks(rows: Rows) -> list[float]:
    """The marks of starts."""
    return rows["start_state"][:, 0].tolist()


def test_starts_are_of_games_and_held_starts_of_later_rounds() -> None:
    states = make_states(7, SOME_BLOCKED, mark=np.arange(7.0))
    # Held: in the first round of a game, the second, the third; one finger touches; a blocked gripper; free twice.
    states[[0, 1, 2, 4], SOME_BLOCKED["contacts"]] = 1.0
    states[3, SOME_BLOCKED["contacts"].start] = 1.0
    states[4, SOME_BLOCKED["gripper_blocked"]] = 1.0
    starts = {"start_state": states, "start_position": np.arange(21.0).reshape(7, 3)}
    # Bob's turns began elsewhere, all in the hand.
    elsewhere = make_states(7, SOME_BLOCKED, mark=-1.0, held=True)
    records = make_records([(0.1, 0.0, 0.025)] * 7, start_state=elsewhere, round_index=[0, 1, 2, 1, 1, 0, 1])
    summary = summary_of(records, CELLS, TASKS, starts)
    assert marks(summary.starts) == [0.0, 5.0]
    assert marks(summary.held_starts) == [1.0, 2.0]
    assert summary.held_starts["start_position"].tolist() == [[3.0, 4.0, 5.0], [6.0, 7.0, 8.0]]


def test_of_both_kinds_of_starts_so_many_are_kept() -> None:
    states = make_states(100, SOME_BLOCKED, mark=np.arange(100.0), held=True)
    records = make_records([(0.1, 0.0, 0.025)] * 100, round_index=np.arange(100) % 2)
    summary = summary_of(records, CELLS, TASKS, make_starts(states), max_starts=20)
    for kept, odd in ((summary.starts, 0), (summary.held_starts, 1)):
        assert len(set(marks(kept))) == 20
        assert set(np.array(marks(kept)) % 2) == {odd}
        assert marks(kept) == sorted(marks(kept))
    several = summary_of(records, CELLS, TASKS, make_starts(states), max_starts=50)
    assert marks(several.starts) + marks(several.held_starts) == [*range(0, 100, 2), *range(1, 100, 2)]


def random_records(rng: np.random.Generator, num: int) -> GoalRecords:
    """Whatever may happen, in no order."""
    flags = {name: rng.random(num) < 0.4 for name in ("replayed", "from_reset", "solved", "alice_past")}
    return make_records(
        rng.uniform([-0.2, -0.15, 0.0], [0.1, 0.15, 0.3], size=(num, 3)),
        goal=rng.uniform([-0.2, -0.15, 0.0], [0.1, 0.15, 0.3], size=(num, 3)),
        start_state=rng.integers(2, size=(num, SOME_BLOCKED.size)).astype(float),
        start_position=rng.uniform(-0.1, 0.1, size=(num, 3)),
        verdict=rng.integers(4, size=num).astype(np.int8),
        played=rng.random(num) < 0.8,
        bob_past=~flags["alice_past"] & (rng.random(num) < 0.2),
        num_bob_steps=rng.integers(1, 40, size=num),
        round_index=rng.integers(3, size=num),
        **flags,
    )


def part(records: GoalRecords, rows: slice) -> GoalRecords:
    return GoalRecords(**{field.name: getattr(records, field.name)[rows] for field in fields(records)})


def assert_same(one: GoalSummary, other: GoalSummary) -> None:
    for field in fields(GoalSummary):
        left, right = getattr(one, field.name), getattr(other, field.name)
        if isinstance(left, dict):
            assert left.keys() == right.keys()
        pairs: list[tuple[Any, Any]] = (
            [(left[key], right[key]) for key in left] if isinstance(left, dict) else [(left, right)]
        )
        for here, there in pairs:
            np.testing.assert_allclose(here, there, rtol=1e-12, err_msg=field.name)


def test_many_actors_together_tell_what_one_does() -> None:
    records = random_records(np.random.default_rng(1), 300)
    whole = summary_of(records, CELLS, TASKS)
    rounds = slice(0, 20), slice(20, 21), slice(21, 300)
    joined = join_summaries([summary_of(part(records, rows), CELLS, TASKS) for rows in rounds])
    assert min(len(rows["start_state"]) for rows in (whole.starts, whole.held_starts)) > 10
    assert [name for name, (num, _) in whole.metrics.items() if not num] == []
    assert_same(joined, whole)
    assert_same(join_summaries([whole]), whole)
    generators = [TaskGenerator(CONFIG, SOME_BLOCKED) for _ in range(2)]
    metrics = [generator.record(each) for generator, each in zip(generators, (whole, joined), strict=True)]
    assert metrics[0] == pytest.approx(metrics[1])
    assert [int(generator.grid.counts.num_tries.sum()) for generator in generators] == [int(whole.tries.sum())] * 2
    assert [int(each.difficulty.num_tries.sum()) for each in generators] == [int(whole.task_tries.sum())] * 2


def test_more_goals_than_their_places_are_sampled() -> None:
    num = 400
    records = make_records(np.linspace([-0.2, 0.0, 0.025], [0.1, 0.0, 0.025], num))
    summary = summary_of(records, CELLS, TASKS, max_goals=50)
    goals = summary.goals["goal"][:, 0]
    assert len(set(goals)) == 50
    assert set(goals) <= set(records.goal[:, 0])
    assert (np.diff(goals) > 0).all()
    assert abs(np.mean(goals) - (-0.05)) < 3 * 0.3 / np.sqrt(12 * 50)  # from everywhere
    assert summary.proposed.sum() == summary.tries.sum() == num  # sums leave nothing out
    assert len(summary.shown) == GOALS_PER_ITERATION


@pytest.mark.parametrize(
    ("max_goals", "max_starts", "untouched"), [(5, 3, True), (4, 3, False), (5, 2, False)], ids=str
)
def test_random_numbers_are_left_alone_where_nothing_is_left_out(
    max_goals: int, max_starts: int, untouched: bool
) -> None:
    """Five goals, and three starts in the hand."""
    records = make_records([(0.1, 0.0, 0.025)] * 5, round_index=[0, 0, 1, 1, 1])
    starts = make_starts(make_states(5, SOME_BLOCKED, held=True))
    rng, same = np.random.default_rng(3), np.random.default_rng(3)
    reached = CELLS.count(CELLS.index(records.proposal))
    limits = {"max_goals": max_goals, "max_starts": max_starts}
    summarize(records, starts, reached, CELLS, TASKS, **limits, rng=rng)
    assert (rng.bit_generator.state == same.bit_generator.state) is untouched


def test_a_world_whose_gripper_is_blocked_holds_nothing():
    config = CONFIG.model_copy(update={"world": CONFIG.world.model_copy(update={"gripper": "blocked"})})
    tasks = TaskBins(config, build_layout(config.world))
    states = np.ones((3, build_layout(config.world).size))  # both fingers touch
    assert tasks.blocked(states).all()
    assert not tasks.held(states).any()
    goal, start = np.array([[0.0, 0.0, 0.2]]), np.array([[0.1, 0.0, 0.025]])
    assert tasks.index(goal, start, states[:1])[0] < len(tasks)
