"""Summary of a round's goals: sums that add up, and a sample that is bounded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from service.config import parse_config
from service.envs.state_layout import StateLayout
from service.generator.bins import NUM_TASK_BINS, GoalCells, TaskBins
from service.generator.generator import TaskGenerator
from service.generator.records import GOALS_PER_ITERATION, GoalRecords
from service.generator.summary import GoalSummary, join_summaries, summarize
from service.generator.validity import Verdict
from tests.generator.outcomes import starts_of, summary_of

CONFIG = parse_config({"game": {"blocked_gripper_fraction": 0.2}}, where="test")
LAYOUT = StateLayout(positions={}, velocities={}, measured={}, kept={"gripper_blocked": 1, "object_mass": 2})
CELLS, TASKS = GoalCells(CONFIG.world, CONFIG.generator.cell_size_m), TaskBins.from_config(CONFIG, LAYOUT)
BLOCKED = LAYOUT["gripper_blocked"].start
MakeRecords = Callable[..., GoalRecords]


def at(*goals: tuple[float, ...]) -> list[int]:
    """Cells of goals."""
    return CELLS.index(np.array(goals)).tolist()


def counted(counts: np.ndarray) -> dict[int, int]:
    """Bins that are not empty."""
    return {int(index): int(counts[index]) for index in np.flatnonzero(counts)}


def test_six_worlds_by_hand(make_records: MakeRecords) -> None:
    near, far, other = (-0.1, 0.0, 0.025), (0.1, 0.0, 0.225), (-0.2, 0.1, 0.025)
    state = np.zeros((6, LAYOUT.size))
    state[3, BLOCKED] = 1.0
    records = make_records(
        [near, near, far, other, far, (0.5, 0.0, 0.0)],
        goal=[near, near, far, near, other, near],
        start_state=state,
        start_position=[(0.0, 0.0, 0.025)] * 6,
        # Solved as proposed; a past Bob's; diverged; from a reset, blocked; replayed from its own start; from a reset.
        verdict=np.array([0, 0, 0, 0, 0, Verdict.OUTSIDE], dtype=np.int8),
        replayed=[False, False, False, True, True, True],
        from_reset=[True, False, False, True, False, True],
        played=[True, True, False, True, True, True],
        solved=[True, True, False, False, True, True],
        bob_past=[False, True, False, False, False, False],
    )
    summary = summary_of(records, CELLS, TASKS, starts_of([1.0] * 4, [2.0] * 4))
    assert counted(summary.proposed) == dict(zip(at(near, far, other), (2, 2, 1), strict=True))
    assert counted(summary.tries) == dict.fromkeys(at(near, other), 1)
    assert counted(summary.successes) == dict.fromkeys(at(near, other), 1)
    bin_of_near = 1  # on the table, 0.10 m away
    assert counted(summary.reset_tries) == {bin_of_near: 2, bin_of_near + NUM_TASK_BINS: 1}
    assert counted(summary.reset_successes) == {bin_of_near: 2}
    assert summary.goals["goal"].tolist() == [list(near), list(near)]
    assert summary.starts["start_state"][:, 0].tolist() == [1.0, 2.0]
    assert summary.shown.shape == (1, 7)
    assert summary.metrics["bob/success_rate"] == (1, 1.0)
    assert summary.metrics["bob/success_rate_from_reset"] == (3, 2.0)
    assert summary.metrics["bob/success_rate_blocked"] == (1, 0.0)
    assert summary.metrics["alice/valid_fraction"] == (6, 5.0)
    assert summary.heights.sum() == 5


def random_records(make_records: MakeRecords, rng: np.random.Generator, num: int) -> GoalRecords:
    """Whatever may happen, in no order."""
    flags = {name: rng.random(num) < 0.4 for name in ("replayed", "from_reset", "solved", "alice_past")}
    return make_records(
        rng.uniform([-0.2, -0.15, 0.0], [0.1, 0.15, 0.3], size=(num, 3)),
        goal=rng.uniform([-0.2, -0.15, 0.0], [0.1, 0.15, 0.3], size=(num, 3)),
        start_state=rng.integers(2, size=(num, LAYOUT.size)).astype(float),
        start_position=rng.uniform(-0.1, 0.1, size=(num, 3)),
        verdict=rng.integers(4, size=num).astype(np.int8),
        played=rng.random(num) < 0.8,
        bob_past=~flags["alice_past"] & (rng.random(num) < 0.2),
        num_bob_steps=rng.integers(1, 40, size=num),
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


def test_many_actors_together_tell_what_one_does(make_records: MakeRecords) -> None:
    records = random_records(make_records, np.random.default_rng(1), 300)
    whole = summary_of(records, CELLS, TASKS, starts_of([1.0] * 4, [2.0] * 4))
    joined = join_summaries(
        [
            summary_of(part(records, slice(0, 20)), CELLS, TASKS, starts_of([1.0] * 4)),
            summary_of(part(records, slice(20, 21)), CELLS, TASKS),
            summary_of(part(records, slice(21, 300)), CELLS, TASKS, starts_of([2.0] * 4)),
        ]
    )
    assert [name for name, (num, _) in whole.metrics.items() if not num] == []
    assert_same(joined, whole)
    assert_same(join_summaries([whole]), whole)
    generators = [TaskGenerator(CONFIG, LAYOUT) for _ in range(2)]
    metrics = [generator.record(each) for generator, each in zip(generators, (whole, joined), strict=True)]
    assert metrics[0] == pytest.approx(metrics[1])
    assert [int(generator.grid.counts.num_tries.sum()) for generator in generators] == [int(whole.tries.sum())] * 2


def test_more_goals_than_their_places_are_sampled(make_records: MakeRecords) -> None:
    num = 400
    records = make_records(np.linspace([-0.2, 0.0, 0.025], [0.1, 0.0, 0.025], num))
    starts = starts_of(*([float(index)] * 4 for index in range(100)))
    summary = summary_of(records, CELLS, TASKS, starts, max_goals=50, max_starts=20)
    goals, kept = summary.goals["goal"][:, 0], summary.starts["start_state"][:, 0]
    assert (len(set(goals)), len(set(kept))) == (50, 20)
    assert set(goals) <= set(records.goal[:, 0])
    assert (np.diff(goals) > 0).all()
    assert (np.diff(kept) > 0).all()
    assert abs(np.mean(goals) - (-0.05)) < 3 * 0.3 / np.sqrt(12 * 50)  # from everywhere
    assert summary.proposed.sum() == summary.tries.sum() == num  # sums leave nothing out
    assert len(summary.shown) == GOALS_PER_ITERATION


def test_random_numbers_are_left_alone_where_nothing_is_left_out(make_records: MakeRecords) -> None:
    records, starts = make_records([(0.1, 0.0, 0.025)] * 5), starts_of([1.0] * 4)
    for max_goals, untouched in ((5, True), (4, False)):
        rng, same = np.random.default_rng(3), np.random.default_rng(3)
        summarize(records, starts, CELLS, TASKS, max_goals=max_goals, max_starts=1, rng=rng)
        assert (rng.bit_generator.state == same.bit_generator.state) is untouched
