"""Goals of several objects: which turns make one, their arrangements, cells and bins, and the choice among them."""

from dataclasses import replace

import numpy as np
import pytest

from service.config import parse_config
from service.envs.batch import WorldBatch
from service.envs.observations import distances
from service.envs.sampling import are_apart
from service.envs.scene import build_layout
from service.generator.bins import (
    NUM_TASK_BINS,
    ONE_MOVED,
    SEVERAL_MOVED,
    STACKED,
    GoalCells,
    TaskBins,
    arrangements,
    highest,
)
from service.generator.difficulty import DifficultyGrid
from service.generator.generator import TaskGenerator
from service.generator.opponents import CURRENT, RoundPlan
from service.generator.records import of_furthest
from service.generator.snapshot import _one_stays
from service.generator.validity import Verdict, classify_goal, proposed
from service.methods.method import goal_grid

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
    found = arrangements(goals, np.tile(START, (len(goals), 1)), WORLD, 0.05)
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
    np.testing.assert_allclose(grid.novelty_of_arrangements(), [0.5, 1.0, 1.0])
    copy = DifficultyGrid(grid.cells)
    copy.load_state(grid.state())
    np.testing.assert_array_equal(copy.novelty_of_arrangements(), grid.novelty_of_arrangements())


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
    given = (plan, states, places, nobody, places, invalid, np.random.default_rng(1))
    playing = parse_config(
        {"world": {"objects": ["cube", "cube"]}, "generator": {"goal_source": "reached", "replay_invalid": True}},
        where="test",
    )
    choice = replace(snapshot, config=playing).choose_goals(*given)
    assert choice.played.all()
    assert choice.replayed.all()
    assert are_apart(choice.goal, WORLD).all()
    assert 0.15 < choice.goal[:, [2, 5]].max() <= 0.2  # and in the cells above those
    num_moved = (distances(choice.goal, choice.start_position) > 1e-9).sum(axis=1)
    assert set(num_moved.tolist()) == {1, 2}
    assert 0.3 < (num_moved == 1).mean() < 0.7


def test_what_is_held_at_the_start_does_not_stay(snapshot):
    held = np.tile([-0.1, 0.0, 0.15, 0.05, 0.0, 0.025], (2000, 1))
    goal = np.tile([0.0, 0.1, 0.025, -0.1, -0.1, 0.025], (2000, 1))
    found = _one_stays(goal, held, WORLD, np.random.default_rng(0))
    stays = np.isclose(found, held).reshape(-1, 2, 3).all(axis=2)
    assert not stays[:, 0].any()
    assert 0.4 < stays[:, 1].mean() < 0.6


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
