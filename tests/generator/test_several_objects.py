"""Goals of several objects: which turns make one, their arrangements, cells and bins, and the choice among them."""

from dataclasses import replace

import numpy as np
import pytest

from service.config import parse_config
from service.config.world import RandomisationConfig
from service.envs.batch import WorldBatch
from service.envs.observations import distances
from service.envs.sampling import are_apart
from service.envs.scene import build_layout
from service.generator.bins import (
    ARRANGEMENT_NAMES,
    NUM_TASK_BINS,
    ONE_MOVED,
    SEVERAL_MOVED,
    STACKED,
    GoalCells,
    TaskBins,
    highest,
)
from service.generator.difficulty import DifficultyGrid, novelty
from service.generator.generator import TaskGenerator
from service.generator.opponents import CURRENT, RoundPlan
from service.generator.records import of_furthest, summarize
from service.generator.snapshot import _one_stays
from service.generator.validity import Verdict, classify_goal, proposed
from service.methods.method import goal_grid
from tests.generator.outcomes import make_records, record

CONFIG = parse_config(
    {"world": {"objects": ["cube", "cube"]}, "generator": {"goal_source": "reached", "replay_invalid": True}},
    where="test",
)
WORLD = CONFIG.world
LAYOUT = build_layout(WORLD)
NO_ARRANGEMENT = np.zeros(3, dtype=np.int64)
START = np.array([-0.1, 0.0, 0.025, 0.05, 0.0, 0.025])
FALLEN, OUTSIDE = [0.6, 0.0, -0.3], [0.3, 0.0, 0.025]


def moved(first=(0.0, 0.0, 0.0), second=(0.0, 0.0, 0.0)):
    return START + np.array([*first, *second])


def test_verdicts_and_goals_by_hand():
    ends = np.array([
        START,
        moved((0.06, 0.0, 0.0)),
        moved((0.02, 0.0, 0.0), (0.0, 0.1, 0.0)),
        moved((0.06, 0.0, 0.0), (0.0, 0.1, 0.1)),
        [*moved((0.06, 0.0, 0.0))[:3], *FALLEN],
        [*moved((0.06, 0.0, 0.0))[:3], *OUTSIDE],
        [np.nan, 0.0, 0.0, *START[3:]],
    ])  # fmt: skip
    starts = np.tile(START, (len(ends), 1))
    kinds = [Verdict.NOT_MOVED, *[Verdict.VALID] * 3, Verdict.FALLEN, Verdict.OUTSIDE, Verdict.FALLEN]
    assert classify_goal(starts, ends, WORLD.workspace, 0.05).tolist() == kinds
    goals = proposed(starts[:4], ends[:4], 0.05)
    np.testing.assert_array_equal(goals[[0, 1, 3]], ends[[0, 1, 3]])
    np.testing.assert_array_equal(goals[2], moved(second=(0.0, 0.1, 0.0)))  # what was only nudged is to stay


def test_arrangements_by_hand():
    on_second = START[3:] - START[:3] + [0.0, 0.0, 0.05]
    goals = np.array([
        moved((0.06, 0.0, 0.0)),
        moved((0.06, 0.0, 0.0), (0.0, 0.06, 0.0)),
        moved(on_second),
        moved(np.add(on_second, [0.024, 0.0, 0.009])),
        moved(np.add(on_second, [0.026, 0.0, 0.0])),  # too far from the middle
        moved(np.add(on_second, [0.0, 0.0, 0.011])),  # held above it
        moved(second=START[:3] - START[3:] + [0.0, 0.0, 0.05]),
    ])  # fmt: skip
    found = TaskBins(CONFIG, LAYOUT).arrangements(goals, np.tile(START, (len(goals), 1)))
    assert found.tolist() == [ONE_MOVED, SEVERAL_MOVED, STACKED, STACKED, ONE_MOVED, ONE_MOVED, STACKED]


def test_cells_are_of_the_object_that_goes_furthest():
    cells = GoalCells(WORLD, 0.05)
    half = len(cells) // 2
    assert half == 7 * 7 * 7
    goals, starts = np.array([moved((0.1, 0.0, 0.0)), moved((0.06, 0.0, 0.0), (0.0, 0.1, 0.0))]), np.tile(START, (2, 1))
    both = cells.index(goals)
    assert (both[:, 0] < half).all()
    assert (both[:, 1] >= half).all()
    assert cells.of_moved(goals, starts).tolist() == [both[0, 0], both[1, 1]]
    same_place = cells.index(np.array([[0.0, 0.0, 0.1, 0.0, 0.0, 0.1]]))[0]
    assert same_place[1] - same_place[0] == half


def test_a_cell_beside_one_of_another_object_is_not_near():
    grid = DifficultyGrid(GoalCells(WORLD, 0.05))
    half, none = len(grid.cells) // 2, np.zeros(len(grid.cells), dtype=np.int64)
    reached = none.copy()
    reached[half] = 1  # the first corner, by the second object
    grid.record(none, reached, none, none, NO_ARRANGEMENT)
    near = np.flatnonzero(grid.near_reached())
    assert near.tolist() == [half, half + 1, half + 7, half + 49]


def test_novelty_of_arrangements_ages_with_proposals():
    grid = DifficultyGrid(GoalCells(WORLD, 0.05))
    none = np.zeros(len(grid.cells), dtype=np.int64)
    grid.record(none, none, none, none, np.array([3, 0, 0]))
    np.testing.assert_allclose(novelty(grid.arranged), [0.5, 1.0, 1.0])
    copy = DifficultyGrid(grid.cells)
    copy.load_state(grid.state())
    np.testing.assert_array_equal(novelty(copy.arranged), novelty(grid.arranged))


def test_bins_tell_arrangements_apart():
    tasks = TaskBins(CONFIG, LAYOUT)
    goals = np.array([moved((0.06, 0.0, 0.0)), moved((0.06, 0.0, 0.0), (0.0, 0.06, 0.0))])
    starts, states = np.tile(START, (2, 1)), np.zeros((2, LAYOUT.size))
    one, several = tasks.index(goals, starts, states)
    assert several - one == NUM_TASK_BINS
    states[0, LAYOUT["contacts"]] = [0.0, 0.0, 1.0, 1.0]  # the second object is held
    states[1, LAYOUT["contacts"]] = [1.0, 0.0, 0.0, 1.0]  # a finger on each
    assert tasks.held(states).tolist() == [True, False]
    assert len(tasks) == 2 * 3 * NUM_TASK_BINS


def test_the_highest_counts_as_if_it_were_the_first():
    cylinder = {"shape": "cylinder", "size_m": (0.04, 0.09)}
    world = parse_config({"world": {"objects": ["cube", cylinder]}}, where="test").world
    places = np.array([[0.0, 0.1, 0.1, 0.2, 0.0, 0.045], [0.0, 0.1, 0.025, 0.2, 0.0, 0.065]])
    np.testing.assert_allclose(highest(places, world), [[0.0, 0.1, 0.1], [0.2, 0.0, 0.045]])


@pytest.fixture(scope="module")
def snapshot():
    """After objects were brought everywhere on the table and up to 15 cm."""
    generator = TaskGenerator(CONFIG, LAYOUT)
    height = np.arange(len(generator.cells)) % 7
    generator.grid.reached |= height < 3
    return generator.snapshot()


def test_goals_in_cells_that_both_have_reached_and_every_second_for_one_object(snapshot):
    num = 200
    with WorldBatch(WORLD, num, num_threads=1) as worlds:
        worlds.reset(np.random.default_rng(0))
        states, places = worlds.states.copy(), worlds.object_position.copy()
    plan, nobody = RoundPlan(np.full(num, CURRENT), np.full(num, CURRENT)), np.zeros(num, dtype=np.int64)
    invalid = np.full(num, Verdict.NOT_MOVED, dtype=np.int8)
    given = (plan, states, places, nobody, places, invalid)
    playing = parse_config(
        {"world": {"objects": ["cube", "cube"]}, "generator": {"goal_source": "reached", "replay_invalid": True}},
        where="test",
    )
    snapshot = replace(snapshot, config=playing)
    choice = snapshot.choose_goals(*given, rng=np.random.default_rng(1))
    assert choice.played.all()
    assert choice.replayed.all()
    assert are_apart(choice.goal, WORLD).all()
    assert 0.15 < choice.goal[:, [2, 5]].max() <= 0.2  # and in the cells above those
    num_moved = (distances(choice.goal, choice.start_position) > 1e-9).sum(axis=1)
    assert set(num_moved.tolist()) == {1, 2}
    assert 0.3 < (num_moved == 1).mean() < 0.7


def test_what_is_held_or_lies_on_another_at_the_start_does_not_stay():
    held = np.tile([-0.1, 0.0, 0.15, 0.05, 0.0, 0.025], (2000, 1))
    goal = np.tile([0.0, 0.1, 0.025, -0.1, -0.1, 0.025], (2000, 1))
    on_the_other = np.tile([0.05, 0.0, 0.075, 0.05, 0.0, 0.025], (2000, 1))
    for start in (held, on_the_other):
        found = _one_stays(goal, start, WORLD, np.random.default_rng(0))
        stays = np.isclose(found, start).reshape(-1, 2, 3).all(axis=2)
        assert not stays[:, 0].any()
        assert 0.4 < stays[:, 1].mean() < 0.6


def test_on_a_high_table_either_object_may_be_the_one_that_moves():
    high = WORLD.model_copy(update={"randomisation": RandomisationConfig(table_height_m=(0.03, 0.05))})
    start = np.tile([-0.1, 0.0, 0.075, 0.05, 0.0, 0.075], (2000, 1))
    goal = np.tile([0.0, 0.1, 0.075, -0.1, -0.1, 0.075], (2000, 1))
    stays = np.isclose(_one_stays(goal, start, high, np.random.default_rng(0)), start).reshape(-1, 2, 3).all(axis=2)
    np.testing.assert_allclose(stays.mean(axis=0), [0.25, 0.25], atol=0.05)
    held = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    found = _one_stays(goal, start + held, high, np.random.default_rng(0))
    assert not np.isclose(found[:, :3], (start + held)[:, :3]).all(axis=1).any()


def test_a_goal_that_would_be_in_the_way_of_what_stays_is_as_it_was():
    start, goal = np.tile(START, (100, 1)), np.tile([0.05, 0.02, 0.025, -0.1, 0.1, 0.025], (100, 1))
    found = _one_stays(goal, start, WORLD, np.random.default_rng(0))
    second_stays = np.isclose(found[:, 3:], START[3:]).all(axis=1)
    assert not second_stays.any()  # the first would lie on it
    assert np.isclose(found[:, :3], START[:3]).all(axis=1).any()


def test_alices_goals_may_lie_side_by_side(snapshot):
    beside = {"goal": np.array([moved((0.1, 0.0, 0.0))]), "start_position": START[None]}  # faces touch
    assert snapshot._is_task(start_state=np.zeros((1, LAYOUT.size)), **beside).tolist() == [True]


def test_rows_of_goals_are_of_the_object_that_goes_furthest():
    rows = [[*START, *moved((0.1, 0.0, 0.0)), 1.0], [*START, *moved((0.06, 0.0, 0.0), (0.0, 0.1, 0.0)), 0.0]]
    found = of_furthest(rows)
    np.testing.assert_allclose(found[0], [*START[:3], *moved((0.1, 0.0, 0.0))[:3], 1.0])
    np.testing.assert_allclose(found[1], [*START[3:], *moved(second=(0.0, 0.1, 0.0))[3:], 0.0])
    assert of_furthest([]).shape == (0, 7)
    with pytest.raises(ValueError, match="rows of 8 numbers are no goals"):
        of_furthest([[0.0] * 8])


def test_the_map_has_one_cell_for_a_place():
    cells = GoalCells(WORLD, 0.05)
    half = len(cells) // 2
    tries, rates = np.zeros(len(cells), dtype=np.int64), np.full(len(cells), 0.5)
    tries[[3, half + 3, half + 9]], rates[[3, half + 3, half + 9]] = [1, 3, 2], [1.0, 0.2, 0.7]
    grid = goal_grid(cells, np.flatnonzero(tries), tries, rates, 1, 100)
    assert (grid.num_cells, [cell.num_tries for cell in grid.cells]) == (half, [4, 2])
    assert [cell.success_rate for cell in grid.cells] == [pytest.approx(0.4), pytest.approx(0.7)]


def test_goals_from_the_start_of_a_game_have_nothing_of_where_other_worlds_are(snapshot):
    settings = {"goal_source": "reached", "replay_invalid": True, "replay_from_reset": True}
    config = parse_config({"world": {"objects": ["cube", "cube"]}, "generator": settings}, where="test")
    now, at_reset = np.tile(START, (50, 1)), np.tile(moved((0.0, 0.1, 0.0), (0.0, 0.1, 0.0)), (50, 1))
    states = np.zeros((50, LAYOUT.size))
    asked = replace(snapshot, config=config, starts={"start_state": states, "start_position": at_reset})
    tasks = asked._other_tasks(states, now, np.random.default_rng(0))
    num = tasks.num_others
    np.testing.assert_array_equal(tasks.rows["start_position"][num:], at_reset[:1].repeat(num, axis=0))
    stays = [np.isclose(distances(tasks.rows["goal"], place[:1]), 0.0).any(axis=1) for place in (now, at_reset)]
    assert num > 30
    assert not stays[0][num:].any()
    assert not stays[1][:num].any()
    assert 0.3 < stays[0][:num].mean() < 0.6
    assert 0.3 < stays[1][num:].mean() < 0.6


BLUE_MOVED = moved(second=(0.0, 0.1, 0.0))


def test_a_goal_is_as_new_as_its_cell_or_its_arrangement(snapshot):
    cells = snapshot.cells
    blue = cells.index(BLUE_MOVED[None])[0, 1]
    rare = replace(snapshot, novelty=np.where(np.arange(len(cells)) == blue, 0.75, 0.25), novelty_of_arrangements=None)
    for arranged, asked in (([0.5, 0.0, 0.0], 0.75), ([1.0, 0.0, 0.0], 1.0), ([0.0, 1.0, 1.0], 0.75)):
        rare = replace(rare, novelty_of_arrangements=np.array(arranged))  # of one that moved, several, a stack
        given = (np.zeros((1, LAYOUT.size)), START[None], np.zeros(1), BLUE_MOVED[None], np.array([Verdict.VALID]))
        plan = RoundPlan(np.array([CURRENT]), np.array([CURRENT]))
        choice = rare.choose_goals(plan, *given, rng=np.random.default_rng(0))
        assert choice.novelty.tolist() == [asked]


def test_a_proposal_counts_by_where_her_turn_began():
    """Bob plays another goal there, from another start."""
    records = make_records(
        BLUE_MOVED[None], start_position=moved((0.0, 0.15, 0.0))[None], start_state=np.zeros((1, LAYOUT.size))
    )
    starts = {"start_state": records.start_state, "start_position": START[None]}
    cells, tasks = GoalCells(WORLD, 0.05), TaskBins(CONFIG, LAYOUT)
    nowhere, most = np.zeros(len(cells), dtype=np.int64), {"max_goals": 9, "max_starts": 9}
    summary = summarize(records, starts, nowhere, cells, tasks, **most, rng=np.random.default_rng(0))
    assert np.flatnonzero(summary.proposed).tolist() == [cells.index(BLUE_MOVED[None])[0, 1]]
    assert summary.arranged.tolist() == [1, 0, 0]


def test_a_stack_is_as_rare_when_she_has_been_everywhere():
    generator = TaskGenerator(CONFIG, LAYOUT)
    generator.grid.seen[:] = True
    snapshot = generator.snapshot()
    assert snapshot.coverage == 1.0
    assert not snapshot.novelty.any()
    assert snapshot.novelty_of_arrangements.tolist() == [1.0, 1.0, 1.0]


KINDS = tuple(f"{end}{name}{more}" for name in ARRANGEMENT_NAMES for end, more in (("_", ""), ("/", "_fraction")))


def test_success_and_goals_by_arrangement_and_object_by_hand():
    on_the_other = (0.15, 0.0, 0.05)  # the first, from x = -0.1, to above the second at x = 0.05
    goals = np.array([
        moved((0.1, 0.1, 0.0)),
        moved((0.1, 0.1, 0.1)),
        moved(second=(0.0, 0.1, 0.0)),
        moved((0.1, 0.1, 0.0), (0.0, 0.1, 0.1)),
        moved(on_the_other),
    ])  # fmt: skip
    num = len(goals)
    states = np.zeros((num, LAYOUT.size))
    solved = [True, False, True, True, False]
    records = make_records(
        goals, start_position=np.tile(START, (num, 1)), start_state=states, solved=solved, round_index=np.zeros(num)
    )
    generator = TaskGenerator(CONFIG, LAYOUT)
    metrics = record(generator, records)
    found = {name: value for name, value in metrics.items() if "object" in name or name.endswith(KINDS)}
    assert found == pytest.approx({
        "bob/success_rate_one": 2 / 3, "bob/success_rate_several": 1.0, "bob/success_rate_stacked": 0.0,
        "alice/one_fraction": 3 / 5, "alice/several_fraction": 1 / 5, "alice/stacked_fraction": 1 / 5,
        "bob/success_rate_object_1": 1 / 2, "bob/success_rate_object_2": 1.0,
        "alice/lifted_fraction_object_1": 1 / 5, "alice/lifted_fraction_object_2": 1 / 5,
        "generator/num_cells_seen_object_1": 3.0, "generator/num_cells_seen_object_2": 1.0,
    })  # fmt: skip


def test_a_new_cell_of_one_object_is_worth_as_much_however_well_the_other_is_known():
    generator = TaskGenerator(CONFIG, LAYOUT)
    before = generator.snapshot().novelty[-1]
    generator.grid.seen[: len(generator.cells) // 2] = True
    after = generator.snapshot()
    assert after.novelty[-1] == before == 1.0
    assert after.novelty[0] == 0.0
    assert after.coverage == 0.5
