import numpy as np
import pytest

import service
from benchmarks.push_range import DIRECTIONS, best_pushes, measure, positions_behind


def test_the_fastest_of_those_that_go_straight():
    means = np.array(
        [
            [0.5, 0.1, 0.0, 0.0],  # straight
            [0.9, 0.4, 0.0, 0.0],  # 0.4 aside, of 0.9 along: more than 35 %
            [0.8, 0.0, 0.5, 0.0],  # lifts
            [-0.6, 0.0, 0.0, 0.0],
        ],
        dtype=np.float32,
    )
    assert best_pushes(means, DIRECTIONS["+x"]) == np.float32(0.5)
    assert best_pushes(means, DIRECTIONS["-x"]) == np.float32(0.6)
    assert best_pushes(means, DIRECTIONS["+y"]) == -np.inf  # 0.4 along, but 0.9 aside
    assert best_pushes(means[None, :1], DIRECTIONS["+x"]).shape == (1,)


@pytest.mark.parametrize("name", DIRECTIONS)
def test_the_gripper_stands_closed_behind_the_object(name):
    direction = np.array(DIRECTIONS[name])
    found = positions_behind(np.random.default_rng(0), DIRECTIONS[name], 50)
    effector, fingers, place, relative = found[:, :3], found[:, 3:5], found[:, 5:8], found[:, 8:]
    np.testing.assert_allclose(relative, place - effector, atol=1e-6)
    assert not fingers.any()
    along = relative[:, :2] @ direction
    assert along.min() >= 0.0549
    assert along.max() <= 0.0751
    assert np.abs(relative[:, :2] @ direction[::-1]).max() <= 0.0151


def test_champion_pushes_less_well_where_it_has_fewer_weights():
    trained = service.load_primitives("panda-cube@champion", registry="no registry here")
    many, few = (measure(trained, num_places=40, num_weights=num, seed=0) for num in (400, 4))
    assert set(many) == set(DIRECTIONS)
    assert sum(many.values()) < sum(few.values())
    assert measure(trained, num_places=40, num_weights=400, seed=0) == many
