"""The task generator as a whole: goal choice in each mode, recording, stopping, exact resume."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.config import Config, parse_config
from service.config.self_play import GeneratorConfig
from service.generator.bins import NUM_TASK_BINS
from service.generator.difficulty import MEMORY_TRIES
from service.generator.generator import NUM_STARTS, StopCriterion, TaskGenerator
from service.generator.opponents import CURRENT, RoundPlan
from service.generator.records import GoalRecords
from service.generator.ring import Rows
from service.generator.snapshot import LEARNABILITY_FLOOR, MIN_REPLAY_GOALS, GeneratorSnapshot, GoalChoice
from service.generator.validity import Verdict
from tests.generator.outcomes import (
    FREE,
    SOME_BLOCKED,
    STATE_SIZE,
    make_records,
    make_starts,
    make_states,
    only_starts,
    record,
    summary_of,
)

WORLD, GAME, OLD, HELD = 1.0, 2.0, 7.0, 9.0
"""Marks of states: where worlds are now, of a game that began, of the old goal, and of an object in the hand."""
ONE_GAME = make_starts(make_states(1, mark=GAME), position=(0.0, -0.15, 0.025))
"""Its object is 25 cm from the old goal, and not 10 as where that was proposed."""
BLOCKED = SOME_BLOCKED["gripper_blocked"].start
OLD_GOAL = (0.0, 0.1, 0.025)
VALID, OUTSIDE = int(Verdict.VALID), int(Verdict.OUTSIDE)
STOPPING = GeneratorConfig(novelty_window=4, stop_success_rate=0.95)


def config(**generator: Any) -> Config:
    return parse_config({"generator": generator}, where="test")


def remembered(num_tries: int) -> float:
    """The weight of so many tries of a bin: each takes a part of that of those before it."""
    return MEMORY_TRIES * (1.0 - (1.0 - 1.0 / MEMORY_TRIES) ** num_tries)


def all_current(num: int) -> RoundPlan:
    return RoundPlan(np.full(num, CURRENT), np.full(num, CURRENT))


def filled(num_goals: int = MIN_REPLAY_GOALS, starts: Rows | None = None, **settings: Any) -> TaskGenerator:
    """A generator whose buffer holds ``num_goals`` times the same old goal; games began in ``starts``."""
    generator = TaskGenerator(config(**settings), FREE)
    states = make_states(num_goals, mark=OLD)
    record(generator, make_records(np.tile(OLD_GOAL, (num_goals, 1)), start_state=states))
    if starts is not None:
        record(generator, only_starts(starts))
    return generator


def choose(
    source: TaskGenerator | GeneratorSnapshot,
    verdict: list[int],
    plan: RoundPlan | None = None,
    seed: int = 0,
    coverage: float = 1.0,
) -> GoalChoice:
    """Goals of worlds whose Alices all proposed (-0.1, 0, 0.1) of an object at (0, 0, 0.025)."""
    num = len(verdict)
    snapshot = source.snapshot() if isinstance(source, TaskGenerator) else source
    return replace(snapshot, coverage=np.array(coverage)).choose_goals(
        plan or all_current(num),
        make_states(num, mark=WORLD),
        np.tile([0.0, 0.0, 0.025], (num, 1)),
        np.arange(num),
        np.tile([-0.1, 0.0, 0.1], (num, 1)),
        np.array(verdict, dtype=np.int8),
        rng=np.random.default_rng(seed),
    )


def assert_rows(choice: GoalChoice, replayed: list[bool]) -> None:
    """Goal and start of each world come from the same place."""
    assert choice.replayed.tolist() == replayed
    for index, old in enumerate(replayed):
        assert choice.goal[index].tolist() == (list(OLD_GOAL) if old else [-0.1, 0.0, 0.1])
        assert choice.start_state[index].tolist() == [OLD if old else WORLD] + [0.0] * (STATE_SIZE - 1)
        assert choice.start_position[index].tolist() == [0.0, 0.0, 0.025]


def test_by_default_bob_plays_what_alice_proposed() -> None:
    choice = choose(filled(200), [VALID, OUTSIDE, VALID, int(Verdict.NOT_MOVED), int(Verdict.FALLEN)])
    assert_rows(choice, [False] * 5)
    assert choice.played.tolist() == [True, False, True, False, False]


def test_a_choice_tells_how_rare_valid_proposals_are() -> None:
    generator = filled()
    num = len(generator.cells)  # goals were proposed in one of them so far, then in two
    np.testing.assert_allclose(choose(generator, [VALID, OUTSIDE]).novelty, [1 - 1 / num, 0.0], rtol=1e-15)
    record(generator, make_records(np.tile([-0.1, 0.0, 0.1], (8, 1))))
    np.testing.assert_allclose(choose(generator, [VALID, OUTSIDE]).novelty, [(1 - 2 / num) / 3, 0.0], rtol=1e-15)


def test_replayed_goals_fill_worlds_without_one_or_replace_every_valid_one() -> None:
    filling = choose(filled(replay_invalid=True), [VALID, OUTSIDE, VALID])
    assert_rows(filling, [False, True, False])
    assert filling.played.all()
    replacing = choose(filled(replay_fraction=1.0), [VALID, OUTSIDE, VALID])
    assert_rows(replacing, [True, False, True])
    assert replacing.played.tolist() == [True, False, True]


def test_replay_fraction_is_met_on_average() -> None:
    generator = filled(replay_fraction=0.3)
    assert choose(generator, [VALID] * 4000).replayed.mean() == pytest.approx(0.3, abs=0.03)
    assert np.array_equal(choose(generator, [VALID] * 50).replayed, choose(generator, [VALID] * 50).replayed)


def test_replay_fraction_waits_for_coverage() -> None:
    generator = filled(replay_fraction=0.8)
    for coverage in (0.0, 0.25):
        replayed = choose(generator, [VALID] * 4000, coverage=coverage).replayed
        assert replayed.mean() == pytest.approx(0.8 * coverage, abs=0.02)
    assert generator.snapshot().coverage == 1 / len(generator.cells)
    invalid = filled(replay_fraction=0.8, replay_invalid=True)
    assert_rows(choose(invalid, [VALID, OUTSIDE], coverage=0.0), [False, True])


def test_no_replay_before_the_buffer_holds_enough() -> None:
    generator = filled(MIN_REPLAY_GOALS - 1, replay_fraction=1.0, replay_invalid=True)
    assert_rows(choose(generator, [VALID, OUTSIDE]), [False, False])
    record(generator, make_records(OLD_GOAL, start_state=make_states(1, mark=OLD)))
    assert_rows(choose(generator, [VALID, OUTSIDE]), [True, True])


def test_replayed_goals_may_start_where_a_game_did() -> None:
    generator = filled(starts=ONE_GAME, replay_fraction=1.0, replay_from_reset=True)
    num_tries, num = MIN_REPLAY_GOALS, 2000
    first = choose(generator, [VALID] * num)
    # From their own starts the old goals were tried and failed; from so far away nothing is known, so 1/2.
    rate = 1 / (remembered(num_tries) + 2)
    own = rate * (1 - rate) + LEARNABILITY_FLOOR
    share = (0.25 + LEARNABILITY_FLOOR) / (0.25 + LEARNABILITY_FLOOR + own)
    assert first.from_reset.mean() == pytest.approx(share, abs=3 * np.sqrt(share * (1 - share) / num))
    assert (first.start_state[:, 0] == np.where(first.from_reset, GAME, OLD)).all()
    assert first.replayed.all()
    assert (first.goal == OLD_GOAL).all()
    switched_off = filled(starts=ONE_GAME, replay_fraction=1.0, replay_from_reset=False)
    assert not choose(switched_off, [VALID] * num).from_reset.any()


def test_tasks_from_a_reset_wait_until_bob_is_ready() -> None:
    generator = filled(starts=ONE_GAME, replay_fraction=1.0, replay_from_reset=True)
    yes = np.ones(200, dtype=np.bool_)
    begun = {"start_position": np.tile(ONE_GAME["start_position"], (200, 1)), "from_reset": yes, "replayed": yes}
    goals = np.tile(OLD_GOAL, (200, 1))
    record(generator, make_records(goals, **begun))
    assert choose(generator, [VALID] * 500).from_reset.mean() < 0.6  # both kinds hopeless: only the floor speaks
    record(generator, make_records(goals, **begun, solved=np.arange(200) < 150))
    assert choose(generator, [VALID] * 500).from_reset.mean() > 0.75  # 0.19 of 0.19 + 0.04, with the floor


def test_a_start_next_to_the_goal_is_no_task() -> None:
    near = make_starts(make_states(8, mark=GAME), np.add(OLD_GOAL, (0.03, 0.03, 0.0)))
    choice = choose(filled(starts=near, replay_fraction=1.0, replay_from_reset=True), [VALID] * 8)
    assert (choice.start_state[:, 0] == OLD).all()
    assert not choice.from_reset.any()


def test_no_goal_in_the_air_from_a_blocked_reset() -> None:
    settings = {"generator": {"replay_fraction": 1.0, "replay_from_reset": True}}
    generator = TaskGenerator(
        parse_config({**settings, "game": {"blocked_gripper_fraction": 0.2}}, where="t"), SOME_BLOCKED
    )
    goals = np.tile([[0.0, 0.1, 0.025], [0.0, 0.1, 0.2]], (40, 1))
    record(generator, make_records(goals, solved=np.arange(80) < 40))  # no goal's own start is blocked
    games = make_states(400, SOME_BLOCKED, mark=GAME, blocked=np.arange(400) % 2 == 0)
    record(generator, only_starts(make_starts(games)))
    choice = choose(generator, [VALID] * 2000)
    blocked, in_air = choice.start_state[:, BLOCKED] == 1.0, choice.goal[:, 2] > 0.1
    assert choice.from_reset[blocked].all()
    # Bob solves half of all, and is untried where he is blocked. So all count alike: 40 goals on the table and 40 in
    # the air from their own starts, 20 of either from free games, 20 on the table from blocked ones.
    assert (blocked & ~in_air).mean() == pytest.approx(20 / 140, abs=0.05)
    assert (~blocked & in_air).mean() == pytest.approx(60 / 140, abs=0.05)
    assert not (blocked & in_air).any()


def test_blocked_tasks_are_counted_apart() -> None:
    config = parse_config({"game": {"blocked_gripper_fraction": 0.2}}, where="test")
    generator = TaskGenerator(config, SOME_BLOCKED)
    blocked = np.arange(40) % 4 == 0
    states = make_states(40, SOME_BLOCKED, blocked=blocked)
    metrics = record(generator, make_records(np.tile(OLD_GOAL, (40, 1)), start_state=states, solved=~blocked))
    assert metrics["bob/success_rate_blocked"] == 0.0
    assert metrics["bob/success_rate"] == 0.75
    assert metrics["alice/valid_fraction_blocked"] == 1.0
    rates = np.unique(generator.difficulty.learnability())  # of no tries, of 10 failures, of 30 successes
    rates_of = 1 / (remembered(30) + 2), 1 / (remembered(10) + 2), 1 / 2
    expected = [p * (1 - p) for p in rates_of]
    assert rates == pytest.approx(expected)


def test_the_same_goal_is_another_task_once_the_object_is_in_the_hand() -> None:
    """Bob always fails it from the table, and solves half of his tries from the hand."""
    generator = TaskGenerator(config(replay_fraction=1.0), FREE)
    held = np.arange(200) % 2 == 0
    states = make_states(200, held=held, mark=np.where(held, HELD, OLD))
    record(generator, make_records(np.tile(OLD_GOAL, (200, 1)), start_state=states, solved=np.arange(200) % 4 == 0))
    bins = np.flatnonzero(generator.difficulty.num_tries)
    assert bins.tolist() == [1, NUM_TASK_BINS + 1]  # on the table, 10 cm away
    rate = 1 / (remembered(100) + 2)
    np.testing.assert_allclose(generator.difficulty.success_rate()[bins], [rate, 1 / 2], rtol=1e-12)
    failed, half = rate * (1 - rate) + LEARNABILITY_FLOOR, 0.25 + LEARNABILITY_FLOOR
    share = np.mean(choose(generator, [VALID] * 4000).start_state[:, 0] == HELD)
    assert share == pytest.approx(half / (half + failed), abs=0.02)


def test_a_past_bob_plays_no_replayed_goals() -> None:
    generator = filled(replay_fraction=1.0, replay_invalid=True)
    plan = RoundPlan(np.array([0, CURRENT, CURRENT]), np.array([CURRENT, 0, 0]))
    choice = choose(generator, [VALID, VALID, OUTSIDE], plan)
    assert_rows(choice, [True, False, False])
    assert choice.played.tolist() == [True, True, False]


def test_goals_that_nobody_proposed() -> None:
    """From a game's start or from where some world is now, and never where nothing has to be done."""
    settings = {"goal_source": "uniform", "replay_invalid": True, "replay_from_reset": True}
    generator = TaskGenerator(config(**settings), FREE)
    record(generator, make_records(np.tile(OLD_GOAL, (4, 1))))
    record(generator, only_starts(ONE_GAME))
    choice = choose(generator, [OUTSIDE] * 4000)
    assert choice.replayed.all()
    assert choice.played.all()
    assert (choice.start_state[:, 0] == np.where(choice.from_reset, GAME, WORLD)).all()
    assert 0.4 < choice.from_reset.mean() < 0.6
    x, y, z = choice.goal.T
    assert (z == 0.025).mean() == pytest.approx(0.3, abs=0.04)
    assert len(np.unique(choice.goal, axis=0)) > 500
    for values, low, high in ((x, -0.225, 0.125), (y, -0.175, 0.175)):
        assert values.min() >= low
        assert values.max() <= high
        assert np.histogram(values, 5, (low, high))[0].min() > 500
    assert (np.linalg.norm(choice.goal - choice.start_position, axis=1) > 0.05).all()


def everywhere(records: GoalRecords, generator: TaskGenerator) -> None:
    """Tell a generator of a round in which an object was in every cell."""
    summary = summary_of(records, generator.cells, generator.tasks)
    generator.record(replace(summary, reached=np.ones(len(generator.cells), dtype=np.int64)))


@pytest.mark.parametrize("source", ["uniform", "reached"])
def test_new_goals_are_drawn_by_learnability(source: str) -> None:
    """Bob always solves goals more than 20 cm above the table; of others nothing is known.

    Of mixed goals 0.7 are anywhere from 2.5 to 35 cm, so 0.7 * 125 / 325 are as high as that. Of all goals 2.4 % are no
    tasks: within 5 cm of the object are 6.4 % of those on the table, and 0.7 % of the rest.
    """
    generator = TaskGenerator(config(goal_source=source, replay_invalid=True), FREE)
    solved = np.repeat([(0.0, 0.0, 0.25), (0.0, 0.0, 0.34)], 100, axis=0)  # up to 30 cm away, and further
    everywhere(make_records(solved, solved=np.ones(200, dtype=np.bool_)), generator)
    known = (remembered(100) + 1) / (remembered(100) + 2) ** 2
    high, other = (1.0, 1.0) if source == "uniform" else (known + LEARNABILITY_FLOOR, 0.25 + LEARNABILITY_FLOOR)
    num_high = 0.7 * 125 / 325
    share = num_high * high / (num_high * high + (1.0 - num_high - 0.024) * other)
    goal = choose(generator, [OUTSIDE] * 4000).goal
    assert np.mean(goal[:, 2] > 0.225) == pytest.approx(share, abs=0.03)  # 0.276, or 0.057


def test_reached_goals_are_drawn_where_an_object_was_and_beside() -> None:
    generator = TaskGenerator(config(goal_source="reached", replay_invalid=True, replay_from_reset=True), FREE)
    assert not choose(generator, [OUTSIDE] * 40).replayed.any()  # nothing was reached yet
    record(generator, make_records([(0.1, 0.1, 0.2)]))
    record(generator, only_starts(ONE_GAME))
    choice = choose(generator, [OUTSIDE] * 400)
    assert choice.replayed.all()
    goals = np.concatenate([choose(generator, [OUTSIDE] * 400, seed=seed).goal for seed in range(20)])
    drawn = np.unique(generator.cells.index(goals).ravel())
    assert drawn.tolist() == np.flatnonzero(generator.grid.near_reached()).tolist()
    assert len(drawn) == 6  # at the workspace's edge


IN_HAND = (0.05, 0.0, 0.2)


def practising(num_held: int) -> TaskGenerator:
    """A generator that draws new goals in all cells; a game began, and as many rounds with the object in the hand."""
    generator = TaskGenerator(config(goal_source="reached", replay_invalid=True, replay_from_reset=True), FREE)
    everywhere(only_starts(ONE_GAME), generator)
    states = make_states(num_held, mark=HELD + np.arange(num_held), held=True)
    record(generator, only_starts(make_starts(states, IN_HAND), round_index=1))
    return generator


def test_half_of_the_tasks_that_begin_with_no_reset_begin_in_the_hand() -> None:
    """All are untried, so equally learnable; as many as all of these together begin with a reset."""
    choice = choose(practising(3), [OUTSIDE] * 4000)
    mark, held = choice.start_state[:, 0], choice.start_state[:, 0] >= HELD
    assert choice.from_reset.mean() == pytest.approx(1 / 2, abs=0.05)
    assert held[~choice.from_reset].mean() == pytest.approx(1 / 2, abs=0.05)
    assert set(mark[~choice.from_reset]) == {WORLD, HELD, HELD + 1, HELD + 2}
    assert set(mark[choice.from_reset]) == {GAME}
    assert (choice.start_position[held] == IN_HAND).all()
    assert (choice.start_position[mark == WORLD] == (0.0, 0.0, 0.025)).all()
    assert (np.linalg.norm(choice.goal - choice.start_position, axis=1) > 0.05).all()


def test_nearly_all_tasks_begin_in_the_hand_where_bob_can_learn_from_these_alone() -> None:
    learnability = np.zeros(2 * NUM_TASK_BINS)
    learnability[NUM_TASK_BINS:] = 0.25
    choice = choose(replace(practising(3).snapshot(), learnability=learnability), [OUTSIDE] * 4000)
    held = choice.start_state[:, 0] >= HELD
    # With the floor each of these weighs 0.26; as many from where worlds are, and twice as many from resets, 0.01.
    assert held.mean() == pytest.approx(0.26 / 0.29, abs=0.02)
    assert held[~choice.from_reset].mean() == pytest.approx(0.26 / 0.27, abs=0.02)


def test_tasks_begin_where_worlds_are_while_no_object_was_ever_held() -> None:
    choice = choose(practising(0), [OUTSIDE] * 4000)
    assert choice.from_reset.mean() == pytest.approx(1 / 2, abs=0.05)
    assert (choice.start_state[:, 0] == np.where(choice.from_reset, GAME, WORLD)).all()


def test_starts_in_the_hand_are_kept_and_the_newest_of_them() -> None:
    generator = practising(3)
    kept = generator.snapshot().held_starts
    assert kept["start_state"][:, 0].tolist() == [HELD, HELD + 1, HELD + 2]
    assert kept["start_position"].tolist() == [list(IN_HAND)] * 3
    assert generator.snapshot().starts["start_state"][:, 0].tolist() == [GAME]
    newer = make_states(NUM_STARTS - 1, mark=100.0, held=True)
    record(generator, only_starts(make_starts(newer), round_index=1))
    marks = generator.snapshot().held_starts["start_state"][:, 0]
    assert sorted(marks) == [HELD + 2] + [100.0] * (NUM_STARTS - 1)


def test_no_drawn_goal_in_the_air_where_the_gripper_is_blocked() -> None:
    settings = {"goal_source": "uniform", "replay_invalid": True}
    tree = {"generator": settings, "game": {"blocked_gripper_fraction": 0.2}}
    snapshot = TaskGenerator(parse_config(tree, where="t"), SOME_BLOCKED).snapshot()
    state = make_states(400, SOME_BLOCKED, blocked=np.arange(400) % 2 == 0)
    index, verdict = np.zeros(400, dtype=np.int64), np.full(400, OUTSIDE, dtype=np.int8)
    place = np.tile([0.0, 0.0, 0.025], (400, 1))
    rng = np.random.default_rng(0)
    choice = snapshot.choose_goals(all_current(400), state, place, index, place, verdict, rng=rng)
    blocked = choice.start_state[:, BLOCKED] == 1.0
    assert 0.1 < blocked.mean() < 0.5
    assert (choice.goal[~blocked, 2] > 0.1).any()
    assert (choice.goal[blocked, 2] <= 0.025 + 0.05).all()


def test_choice_does_not_alias_its_inputs() -> None:
    generator = filled(replay_fraction=1.0)
    start_state, position = make_states(1, mark=WORLD), np.zeros((1, 3))
    verdict = np.zeros(1, dtype=np.int8)
    index = np.zeros(1, dtype=np.int64)
    given = (start_state, position, index, position, verdict)
    generator.snapshot().choose_goals(all_current(1), *given, rng=np.random.default_rng(0))
    assert start_state.tolist() == make_states(1, mark=WORLD).tolist()
    assert position.tolist() == [[0.0] * 3]


def test_replay_prefers_learnable_goals() -> None:
    generator = TaskGenerator(config(replay_fraction=1.0), FREE)
    solved_always, solved_half = (0.1, 0.1, 0.025), (-0.2, -0.1, 0.025)  # 14 and 22 cm away
    goals = [solved_always] * 100 + [solved_half] * 100
    record(generator, make_records(goals, solved=[True] * 100 + [True, False] * 50))
    goal = choose(generator, [VALID] * 4000).goal
    # Each with the floor of 0.01 on top of p (1 - p).
    easy, hard = (remembered(100) + 1) / (remembered(100) + 2) ** 2 + 0.01, 0.25 + 0.01
    assert np.mean(goal[:, 0] > 0) == pytest.approx(easy / (easy + hard), abs=0.015)


def test_record_separates_who_learns_what() -> None:
    generator = TaskGenerator(config(), FREE)
    metrics = record(
        generator,
        make_records(
            [(-0.2, 0.0, 0.02), (-0.1, 0.0, 0.02), (0.0, 0.1, 0.02), (0.1, 0.1, 0.02), (0.5, 0.0, 0.02)],
            goal=[(-0.2, 0.0, 0.02), (-0.1, 0.0, 0.02), (0.0, 0.1, 0.02), (-0.2, 0.0, 0.02), (-0.2, 0.0, 0.02)],
            verdict=np.array([VALID, VALID, VALID, VALID, OUTSIDE], dtype=np.int8),
            replayed=[False, False, False, True, True],
            solved=[True, True, True, False, False],
            alice_past=[False, True, False, False, False],
            bob_past=[False, False, True, False, False],
        ),
    )
    # Four valid proposals open four cells; three of them were played as proposed and are kept.
    assert metrics["generator/new_cells"] == metrics["generator/num_cells_seen"] == 4.0
    assert metrics["generator/buffer_size"] == 3.0
    assert metrics["generator/iterations_without_new_cell"] == 0.0
    assert metrics["bob/success_rate"] == 1.0  # the first world alone
    assert metrics["bob/success_rate_replayed"] == 0.0
    # The current Bob tried the first cell three times and the past Alice's once; the past Bob's try does not count.
    goals = np.array([(-0.2, 0.0, 0.02), (-0.1, 0.0, 0.02), (0.0, 0.1, 0.02), (0.1, 0.1, 0.02)])
    rates = generator.grid.counts.success_rate()[generator.cells.index(goals).ravel()]
    tries = remembered(3)
    np.testing.assert_allclose(rates, [(tries / 3 + 1) / (tries + 2), 2 / 3, 1 / 2, 1 / 2])
    expected = float(np.mean([rate * (1 - rate) for rate in ((tries / 3 + 1) / (tries + 2), 1 / 3, 1 / 2, 1 / 2)]))
    assert metrics["generator/mean_learnability"] == pytest.approx(expected)


def test_an_iteration_without_any_goal() -> None:
    verdict = np.full(2, Verdict.FALLEN, dtype=np.int8)
    records = make_records(np.full((2, 3), np.nan), verdict=verdict, played=[False, False])
    metrics = record(TaskGenerator(config(), FREE), records)
    assert metrics["generator/iterations_without_new_cell"] == 1.0
    assert metrics["generator/buffer_size"] == 0.0
    assert not any(name.startswith("bob/") for name in metrics)
    assert "generator/mean_learnability" not in metrics
    assert all(np.isfinite(value) for value in metrics.values())


YES, NO = np.ones(100, dtype=np.bool_), np.zeros(100, dtype=np.bool_)
FIRST_HALF = np.arange(100) < 50


@pytest.mark.parametrize(
    ("outcomes", "expected"),
    [
        ({"solved": YES}, True),
        ({"solved": NO}, False),
        ({"solved": YES, "replayed": ~FIRST_HALF}, True),
        ({"solved": FIRST_HALF, "replayed": ~FIRST_HALF}, False),  # all of Alice's, none of what he practises
        ({"solved": ~FIRST_HALF, "replayed": ~FIRST_HALF}, False),
        ({"solved": FIRST_HALF, "replayed": ~FIRST_HALF, "from_reset": ~FIRST_HALF}, False),
        ({"solved": YES, "alice_past": FIRST_HALF}, True),
        ({"solved": YES, "bob_past": YES}, False),  # nothing was tried
        ({"solved": FIRST_HALF, "bob_past": FIRST_HALF}, False),
    ],
)
def test_a_run_is_over_once_bob_solves_all_that_he_plays(outcomes: dict[str, Any], expected: bool) -> None:
    generator = TaskGenerator(config(novelty_window=2), FREE)
    for _ in range(3):
        assert not generator.should_stop()
        record(generator, make_records(np.tile(OLD_GOAL, (100, 1)), **outcomes))
    assert generator.should_stop() is expected


def test_opponents_are_due_every_interval() -> None:
    generator = TaskGenerator(config(opponent_interval=10), FREE)
    joined = []
    for iteration in range(35):
        before = generator.opponents
        generator.add_opponents(iteration, {"w": np.ones(2)}, {"w": np.ones(2)})
        joined += [iteration] * (generator.opponents is not before)
    assert joined == [10, 20, 30]


def test_a_snapshot_is_a_copy() -> None:
    """Rounds that go on while the generator records see nothing of it."""
    generator = filled(starts=ONE_GAME, replay_fraction=1.0, replay_from_reset=True)
    snapshot = generator.snapshot()
    before = {name: array.copy() for name, array in snapshot.state().items()}
    play(generator, np.random.default_rng(0), range(20))
    assert all(np.array_equal(array, before[name]) for name, array in snapshot.state().items())
    assert not all(np.array_equal(array, before[name]) for name, array in generator.snapshot().state().items())


@pytest.mark.parametrize("source", ["alice", "reached"])
def test_a_choice_writes_to_nothing_and_draws_the_same_again(source: str) -> None:
    """Snapshots of other processes are read-only."""
    settings: dict[str, Any] = {"goal_source": source, "replay_fraction": 0.5, "replay_from_reset": True}
    generator = filled(starts=ONE_GAME, **settings)
    record(generator, only_starts(make_starts(make_states(2, mark=HELD, held=True), IN_HAND), round_index=1))
    state = generator.snapshot().state()
    for array in state.values():
        array.flags.writeable = False
    snapshot = TaskGenerator(config(**settings), FREE).snapshot().with_state(state)
    first, again, whole = (
        choose(snapshot, [VALID] * 40),
        choose(snapshot, [VALID] * 40),
        choose(generator, [VALID] * 40),
    )
    assert 0 < first.replayed.sum() < 40
    assert first.from_reset.any()
    assert (first.start_state[:, 0] == HELD).any() == (source == "reached")
    for name in GoalChoice.__slots__:
        assert np.array_equal(getattr(first, name), getattr(again, name))
        assert np.array_equal(getattr(first, name), getattr(whole, name))


def play(generator: TaskGenerator, rng: np.random.Generator, iterations: range) -> list[Any]:
    """Run the verbs in call order on made-up proposals; everything that came out.

    In one state of four both contacts are above 0.
    """
    outcomes: list[Any] = []
    lower, upper = np.array([-0.2, -0.15, 0.0]), np.array([0.1, 0.15, 0.3])
    num = 20
    for iteration in iterations:
        plan = generator.opponents.plan(num, 0.2, rng)
        start_state, start = rng.normal(size=(num, STATE_SIZE)), rng.uniform(lower, upper, size=(num, 3))
        proposal = rng.uniform(lower, upper, size=(num, 3))
        verdict = rng.choice([VALID, OUTSIDE], size=num, p=[0.7, 0.3]).astype(np.int8)
        index = rng.integers(3, size=num)
        given = (start_state, start, index, proposal, verdict)
        choice = generator.snapshot().choose_goals(plan, *given, rng=rng)
        records = make_records(
            proposal,
            **{name: getattr(choice, name) for name in GoalChoice.__slots__ if name != "novelty"},
            verdict=verdict,
            solved=choice.played & (rng.random(num) < 0.5),
            alice_past=plan.alice_past,
            bob_past=plan.bob_past,
            round_index=index,
        )
        metrics = record(generator, records, {"start_state": start_state, "start_position": start})
        outcomes.append((plan.alice_opponent.tolist(), choice.goal.tolist(), choice.start_state.tolist(), metrics))
        if iteration % 3 == 0:
            generator.add_opponents(iteration, {"a/w": rng.normal(size=3)}, {"b.w": rng.normal(size=(2, 2))})
        outcomes.append(generator.should_stop())
    return outcomes


@pytest.mark.parametrize("source", ["alice", "reached"])
def test_exact_resume_through_a_file(tmp_path: Path, source: str) -> None:
    settings = config(
        goal_source=source,
        replay_fraction=0.3,
        replay_invalid=True,
        replay_from_reset=True,
        replay_buffer_size=90,
        opponent_interval=3,
        opponent_pool_size=2,
        novelty_window=5,
    )
    generator, rng = TaskGenerator(settings, FREE), np.random.default_rng(5)
    play(generator, rng, range(12))
    np.savez(tmp_path / "state.npz", **generator.state())  # type: ignore[arg-type]
    resumed, resumed_rng = TaskGenerator(settings, FREE), np.random.default_rng()
    resumed_rng.bit_generator.state = rng.bit_generator.state
    with np.load(tmp_path / "state.npz", allow_pickle=False) as state:
        resumed.load_state({name: state[name] for name in state.files})
    assert len(resumed.held_starts) == len(generator.held_starts) > 0
    assert play(resumed, resumed_rng, range(12, 24)) == play(generator, rng, range(12, 24))
    state, again = generator.state(), resumed.state()
    assert list(state) == list(again)
    assert all(np.array_equal(state[name], again[name]) and state[name].dtype == again[name].dtype for name in state)


def test_state_is_a_copy() -> None:
    generator = filled()
    generator.add_opponents(10, {"w": np.ones(2)}, {"w": np.ones(2)})
    state = generator.state()
    before = {name: array.copy() for name, array in state.items()}
    play(generator, np.random.default_rng(0), range(20))
    assert all(np.array_equal(state[name], before[name]) for name in state)


def test_state_of_a_new_generator_loads() -> None:
    generator = filled()
    generator.add_opponents(10, {"w": np.ones(2)}, {"w": np.ones(2)})
    generator.load_state(TaskGenerator(config(), FREE).state())
    assert len(generator.buffer) == len(generator.opponents.alice) == generator.grid.num_cells_seen == 0


def stop_after(*iterations: tuple[int, int, int]) -> StopCriterion:
    stop = StopCriterion(STOPPING)
    for num_new_cells, num_tried, num_solved in iterations:
        stop.record(num_new_cells, num_tried, num_solved)
    return stop


@pytest.mark.parametrize(
    ("iterations", "expected"),
    [
        ([(0, 40, 38)] * 4, True),  # 152 of 160 is exactly 95 %
        ([(0, 40, 38)] * 3 + [(0, 40, 37)], False),
        ([(0, 40, 40)] * 3, False),  # the window is not full
        ([(0, 40, 40)] * 3 + [(1, 40, 40)], False),  # something new at the end
        ([(1, 40, 40)] + [(0, 40, 40)] * 3, False),  # something new at the start of the window
        ([(9, 40, 0)] + [(0, 40, 40)] * 4, True),  # both the novelty and the failures lie before the window
        ([(0, 24, 24)] * 4, False),  # 96 goals are too few
        ([(0, 25, 25)] * 4, True),
        ([(0, 0, 0)] * 9, False),  # an Alice who never proposes does not end the run
        ([], False),
    ],
)
def test_should_stop(iterations: list[tuple[int, int, int]], expected: bool) -> None:
    assert stop_after(*iterations).should_stop() is expected


def test_iterations_without_new_cell() -> None:
    assert stop_after((3, 1, 1), (0, 1, 1), (0, 1, 1)).num_iterations_without_new_cell == 2
    assert stop_after((0, 1, 1), (2, 1, 1)).num_iterations_without_new_cell == 0


def test_state_round_trip_continues_the_window() -> None:
    stop, copy = stop_after((1, 40, 0), (0, 40, 40), (0, 40, 40)), StopCriterion(STOPPING)
    copy.load_state(stop.state())
    decisions: list[list[bool]] = []
    for criterion in (stop, copy):
        decisions.append([])
        for _ in range(3):
            criterion.record(0, 40, 40)
            decisions[-1].append(criterion.should_stop())
    assert decisions == [[False, True, True]] * 2
