"""Counts, cells and bins by hand."""

from __future__ import annotations

import numpy as np
import pytest

from service.config import WorkspaceConfig, WorldConfig, parse_config
from service.generator.bins import (
    NUM_DISTANCE_BINS,
    NUM_TASK_BINS,
    GoalCells,
    TaskBins,
    distance_bins,
    height_bins,
    in_air,
)
from service.generator.difficulty import MEMORY_TRIES, PROPOSAL_DECAY, DifficultyGrid, SuccessCounts, novelty
from service.methods.method import goal_grid
from tests.generator.outcomes import FREE, SOME_BLOCKED, make_states

WORLD = WorldConfig(workspace=WorkspaceConfig(center_x_m=0.1, center_y_m=0.0))

ARRANGED = np.zeros(0, dtype=np.int64)
"""Of one object nothing is counted."""


def make(cell_size_m: float = 0.05) -> DifficultyGrid:
    return DifficultyGrid(GoalCells(WORLD, cell_size_m))


def record(grid: DifficultyGrid, goals: list[tuple[float, ...]], solved: list[bool]) -> int:
    """Valid proposals that were all tried."""
    tried = np.array(goals, dtype=np.float64).reshape(-1, 3)
    proposed = grid.cells.count(grid.cells.index(tried))
    successes = grid.cells.count(grid.cells.index(tried[np.array(solved, dtype=np.bool_)]))
    return grid.record(proposed, proposed, proposed, successes, ARRANGED)


def test_counts_by_hand() -> None:
    counts = SuccessCounts(3)
    counts.record(np.array([2, 1, 0]), np.array([1, 0, 0]))
    keep = 1.0 - 1.0 / MEMORY_TRIES
    # Bin 0: two tries, of which the second counts 1; bin 1: one; bin 2 untried: the prior's mean.
    tries = 1.0 + keep
    np.testing.assert_allclose(counts.tries, [tries, 1.0, 0.0], rtol=1e-12)
    rates = np.array([(tries / 2 + 1) / (tries + 2), 1 / 3, 1 / 2])
    np.testing.assert_allclose(counts.success_rate(), rates, rtol=1e-12)
    np.testing.assert_allclose(counts.learnability(), rates * (1 - rates), rtol=1e-12)
    counts.record(np.array([1, 0, 0]), np.array([0, 0, 0]))
    np.testing.assert_allclose(counts.tries, [1.0 + keep * tries, 1.0, 0.0], rtol=1e-12)
    np.testing.assert_allclose(counts.successes, [keep * tries / 2, 0.0, 0.0], rtol=1e-12)
    assert counts.num_tries.tolist() == [3, 1, 0]


def test_rates_do_not_depend_on_the_number_of_worlds() -> None:
    """The same tries, of which one in four succeeds, from 40 iterations of few worlds or 10 of four times as many."""
    few, many = SuccessCounts(1), SuccessCounts(1)
    for iteration in range(40):
        few.record(np.array([4]), np.array([1]))
        if iteration % 4 == 3:
            many.record(np.array([16]), np.array([4]))
    np.testing.assert_allclose(many.success_rate(), few.success_rate(), rtol=1e-12)
    assert few.tries[0] == pytest.approx(MEMORY_TRIES, rel=0.01)
    np.testing.assert_allclose(few.success_rate(), (MEMORY_TRIES / 4 + 1) / (MEMORY_TRIES + 2), rtol=0.01)
    for _ in range(2):  # after as many tries as are remembered the new rate rules
        few.record(np.array([30]), np.array([30]))
    assert few.success_rate()[0] > 0.8


@pytest.mark.parametrize(
    ("length_m", "cell_size_m", "num_cells"),
    [(0.35, 0.05, 7), (0.6, 0.2, 3), (0.3, 0.1, 3), (0.35, 0.1, 4), (0.35, 1.0, 1), (0.45, 0.03, 15)],
)
def test_number_of_cells(length_m: float, cell_size_m: float, num_cells: int) -> None:
    workspace = WorkspaceConfig(length_x_m=length_m, length_y_m=length_m, height_m=length_m)
    assert GoalCells(WorldConfig(workspace=workspace), cell_size_m).shape == (num_cells,) * 3


def test_cells_cover_an_off_centre_workspace() -> None:
    cells = GoalCells(WORLD, 0.05)
    # Box: x from -0.075 to 0.275, y from -0.175 to 0.175, z from 0 to 0.35.
    goals = np.array(
        [[-0.075, -0.175, 0.0], [0.275, 0.175, 0.35], [-0.01, -0.17, 0.01], [-0.07, -0.12, 0.01], [-0.07, -0.17, 0.06]]
    )
    assert cells.index(goals).ravel().tolist() == [0, 342, 49, 7, 1]
    assert np.flatnonzero(cells.count(cells.index(goals))).tolist() == [0, 1, 7, 49, 342]
    assert cells.count(cells.index(goals[[1, 1, 0]]))[[0, 1, 342]].tolist() == [1, 0, 2]


def test_the_grid_of_what_is_shown() -> None:
    cells = make().cells
    shown = np.flatnonzero(cells.count(cells.index(np.array([(0.20, -0.17, 0.11)]))))  # cell (5, 0, 2)
    numbers = np.arange(len(cells))
    grid = goal_grid(cells, shown, numbers, numbers / 1000, iteration=3, num_env_steps=40)
    (cell,) = grid.cells
    assert (cell.center_m, cell.num_tries, cell.success_rate) == ((0.2, -0.15, 0.125), 247, 0.247)
    assert cell.learnability == round(0.247 * 0.753, 4)
    assert (grid.iteration, grid.num_env_steps, grid.cell_size_m, grid.shape) == (3, 40, 0.05, (7, 7, 7))
    assert grid.num_cells == 343
    assert (grid.lower_m, grid.upper_m) == (WORLD.workspace.lower_m, WORLD.workspace.upper_m)
    assert np.array_equal(cells.index(cells.centers()).ravel(), numbers)


def test_grid_rates_by_hand() -> None:
    grid = make()
    easy, hard, untried = (0.1, 0.1, 0.025), (0.1, -0.1, 0.2), (0.2, 0.0, 0.3)
    record(grid, [easy, hard], [True, False])
    goals = np.array([easy, hard, untried])
    cells = grid.cells.index(goals).ravel()
    np.testing.assert_allclose(grid.counts.success_rate()[cells], [2 / 3, 1 / 3, 1 / 2], rtol=1e-12)
    learnability = grid.counts.learnability()[cells]
    np.testing.assert_allclose(learnability, [2 / 9, 2 / 9, 1 / 4], rtol=1e-12)
    np.testing.assert_allclose(grid.mean_learnability(), 2 / 9, rtol=1e-12)
    np.testing.assert_allclose(grid.mean_success_rate(), (2 / 3 + 1 / 3) / len(grid.cells), rtol=1e-12)
    assert grid.num_cells_seen == 2
    tries = grid.cells.count(grid.cells.index(np.array([untried])))  # a goal that nobody proposed
    grid.record(np.zeros_like(tries), np.zeros_like(tries), tries, tries, ARRANGED)
    assert grid.num_cells_seen == 2
    np.testing.assert_allclose(grid.mean_success_rate(), (2 / 3 + 1 / 3 + 2 / 3) / len(grid.cells), rtol=1e-12)


def test_cells_near_those_that_were_reached() -> None:
    """A corner has three neighbours that share a face, a cell in the middle six; what was reached stays so."""
    grid = make()
    none = np.zeros(len(grid.cells), dtype=np.int64)
    assert not grid.near_reached().any()
    corner, middle = none.copy(), none.copy()
    corner[0], middle[171] = 5, 1  # cells (0, 0, 0) and (3, 3, 3) of 7 x 7 x 7
    grid.record(none, corner, none, none, ARRANGED)
    assert np.flatnonzero(grid.near_reached()).tolist() == [0, 1, 7, 49]
    grid.record(none, middle, none, none, ARRANGED)
    around = [171 - 49, 171 - 7, 170, 171, 172, 171 + 7, 171 + 49]
    assert np.flatnonzero(grid.near_reached()).tolist() == [0, 1, 7, 49, *around]
    assert grid.num_cells_seen == 0  # no goal was proposed in any
    again = make()
    again.load_state(grid.state())
    assert np.array_equal(again.reached, grid.reached)


def test_a_new_cell_is_counted_once_tried_or_not() -> None:
    grid = make()
    assert np.isnan(grid.mean_learnability())
    goals = np.array([[0.1, 0.1, 0.02], [0.1, 0.1, 0.03], [0.1, -0.1, 0.02]])
    proposed, none = grid.cells.count(grid.cells.index(goals)), np.zeros(len(grid.cells), dtype=np.int64)
    assert grid.record(proposed, none, none, none, ARRANGED) == 2
    assert grid.record(proposed, none, none, none, ARRANGED) == 0
    assert grid.record(none, none, none, none, ARRANGED) == 0
    assert grid.num_cells_seen == 2
    assert not grid.counts.num_tries.any()


def test_novelty_by_hand() -> None:
    grid = make()
    goals = np.array([[0.1, 0.1, 0.02]] * 3 + [[0.1, -0.1, 0.02]])
    often, once, never = grid.cells.index(np.array([goals[0], goals[3], (0.2, 0.0, 0.3)])).ravel()
    proposed, none = grid.cells.count(grid.cells.index(goals)), np.zeros(len(grid.cells), dtype=np.int64)
    grid.record(proposed, none, none, none, ARRANGED)  # tried or not
    np.testing.assert_allclose(novelty(grid.proposals)[[often, once, never]], [1 / 2, 0.5**0.5, 1.0], rtol=1e-15)
    grid.record(none, none, none, none, ARRANGED)
    expected = 1.0 / (1.0 + PROPOSAL_DECAY * np.array([3.0, 1.0])) ** 0.5
    np.testing.assert_allclose(novelty(grid.proposals)[[often, once]], expected, rtol=1e-15)


def test_height_bins_split_table_from_air() -> None:
    heights = [0.025, 0.025 + 0.05, 0.0751, 0.125, 0.1251, 0.225, 0.2251, 0.35]
    positions = np.array([[0.0, 0.0, height] for height in heights])
    assert height_bins(positions, 0.025).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert in_air(positions, 0.025).tolist() == [False, False] + 6 * [True]


def test_bins_of_distance_and_height_by_hand() -> None:
    goals = np.array([(0.1, 0.06, 0.025), (0.1, 0.12, 0.025), (0.1, 0.17, 0.025), (0.1, 0.0, 0.205), (0.1, 0.0, 0.33)])
    starts = np.tile([0.1, 0.0, 0.025], (5, 1))  # 0.06, 0.12, 0.17, 0.18 and 0.305 m away
    assert distance_bins(goals, starts).tolist() == [0, 1, 2, 2, 4]
    assert height_bins(goals, 0.025).tolist() == [0, 0, 0, 2, 3]
    assert (NUM_DISTANCE_BINS, NUM_TASK_BINS) == (5, 20)


def make_tasks(blocked_fraction: float) -> TaskBins:
    config = parse_config({"game": {"blocked_gripper_fraction": blocked_fraction}}, where="test")
    return TaskBins(config, SOME_BLOCKED if blocked_fraction else FREE)


def test_an_object_is_held_where_both_fingers_of_a_free_gripper_touch_it() -> None:
    states = make_states(6, SOME_BLOCKED)
    states[:, SOME_BLOCKED["contacts"]] = [(0, 0), (1, 0), (0, 1), (1, 1), (1, 1), (0, 0)]
    states[:, SOME_BLOCKED["gripper_blocked"]] = np.array([[0, 0, 0, 0, 1, 1]]).T
    tasks = make_tasks(0.2)
    assert tasks.held(states).tolist() == [False, False, False, True, False, False]
    assert tasks.blocked(states).tolist() == [False, False, False, False, True, True]
    free = make_states(2, held=np.array([False, True]))  # of worlds in which no gripper is ever blocked
    assert make_tasks(0.0).held(free).tolist() == [False, True]


def test_bins_of_the_same_goal_by_what_the_gripper_does() -> None:
    """In the air, 18 cm away: 2 * 5 + 2 while it is free, 20 on where it holds the object, 40 where it is blocked."""
    goals, starts = np.tile([0.1, 0.0, 0.205], (4, 1)), np.tile([0.1, 0.0, 0.025], (4, 1))
    states = make_states(4, SOME_BLOCKED, held=np.array([0, 1, 0, 1]) > 0, blocked=np.array([0, 0, 1, 1]) > 0)
    tasks = make_tasks(0.2)
    assert tasks.index(goals, starts, states).tolist() == [12, 32, 52, 52]
    assert len(tasks) == 60
    never_blocked = make_tasks(0.0)
    assert never_blocked.index(goals[:2], starts[:2], make_states(2, held=np.array([False, True]))).tolist() == [12, 32]
    assert len(never_blocked) == 40
