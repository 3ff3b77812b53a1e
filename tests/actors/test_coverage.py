"""Coverage by random compositions: the share by hand, and who is asked for what."""

import numpy as np
import pytest

from service.actors.coverage import RandomPolicy, composition_paths, visited_share
from service.config import WorkspaceConfig, WorldConfig

# x and y from -0.1 to 0.1: 4 x 4 cells of 5 cm
SQUARE = WorkspaceConfig(center_x_m=0.0, length_x_m=0.2, length_y_m=0.2)
FAST = WorldConfig(physics_step_s=0.004, num_substeps=10)


def paths(*points):
    """(M, T, 3) trajectories from x, y pairs; heights must not matter."""
    trajectories = np.array(points, dtype=float)
    return np.concatenate([trajectories, np.full((*trajectories.shape[:2], 1), 0.3)], axis=2)


STILL = [(0.025, 0.025)] * 3


@pytest.mark.parametrize(
    ("trajectories", "cells"),
    [
        (paths(STILL), 0),  # where an object merely started does not count
        (paths([(0.01, 0.01), (0.04, 0.04), (0.02, 0.03)]), 0),  # moves, inside its cell
        (paths([(0.025, 0.025), (0.075, 0.025), (0.075, 0.075)]), 2),
        (paths([(0.025, 0.025), (0.075, 0.025), (0.025, 0.025)]), 1),  # back home
        (paths([(0.025, 0.025), (0.075, 0.025)], [(0.025, 0.075), (0.075, 0.025)]), 1),  # the same cell twice
        (paths([(0.025, 0.025), (0.075, 0.025)], [(0.075, 0.025), (0.025, 0.025)]), 2),  # each other's start
        (paths([(0.025, 0.025), (0.11, 0.025), (0.025, -0.3)]), 0),  # outside
        (paths([(0.3, 0.3), (-0.099, -0.099)]), 1),  # from outside into the corner
    ],
)
def test_visited_share_by_hand(trajectories, cells):
    assert visited_share(trajectories, SQUARE) == cells / 16


def test_the_share_is_that_of_the_cells_of_its_workspace():
    assert visited_share(paths([(0.025, 0.025), (-0.075, 0.025)]), WorkspaceConfig()) == 1 / 49


def test_random_policy():
    mean, std = RandomPolicy().compose(np.zeros((5, 11), dtype=np.float32), np.ones((5, 1), dtype=np.float32))
    assert mean.shape == std.shape == (5, 4)
    assert mean.dtype == std.dtype == np.float32
    assert not mean.any()
    assert (std == 1.0).all()


class Recorder:
    """Primitives that keep what they are asked and push nowhere in particular."""

    num_primitives = 3

    def __init__(self):
        self.asked = []

    def compose(self, positions, weights):
        self.asked.append((positions.copy(), weights.copy()))
        return RandomPolicy().compose(positions, weights)


def walk(primitives, *, num_skills=6, num_steps=4, seed=0):
    return composition_paths(primitives, FAST, num_skills=num_skills, num_steps=num_steps, seed=seed, num_threads=1)


def test_a_skill_is_one_weight_held_for_the_whole_episode():
    recorder = Recorder()
    walk(recorder)
    weights = recorder.asked[0][1]
    assert weights.shape == (6, 3)
    assert ((weights > 0.0) & (weights <= 1.0)).all()
    assert len(np.unique(weights)) == 18
    assert len(recorder.asked) == 4
    assert all(np.array_equal(asked, weights) for _, asked in recorder.asked)


def test_trajectories_are_object_positions_from_a_fresh_reset():
    recorder = Recorder()
    trajectories = walk(recorder)
    assert trajectories.shape == (6, 5, 3)
    seen = np.stack([positions[:, 5:8] for positions, _ in recorder.asked], axis=1)
    np.testing.assert_allclose(trajectories[:, :-1], seen, atol=1e-7)
    assert (trajectories[:, 0, 2] == 0.025).all()
    assert len(np.unique(trajectories[:, 0, 0])) == 6


def test_actions_are_sampled():
    class Steady(Recorder):
        def compose(self, positions, weights):
            mean, std = super().compose(positions, weights)
            return mean, 0.0 * std

    noisy, steady = Recorder(), Steady()
    walk(noisy)
    walk(steady)
    end_effectors = [recorder.asked[-1][0][:, :3] for recorder in (noisy, steady)]
    assert np.abs(end_effectors[0] - noisy.asked[0][0][:, :3]).max() > 0.02
    assert np.abs(end_effectors[1] - steady.asked[0][0][:, :3]).max() < 0.002


def test_a_seed_determines_the_trajectories():
    one, same, other = (walk(RandomPolicy(), seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
