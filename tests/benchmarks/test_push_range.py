import json
from pathlib import Path

import numpy as np
import pytest

import service
from benchmarks.push_range import DIRECTIONS, best_pushes, measure, positions_behind
from service.config import load_config
from service.learner.learner import Learner
from service.policies.numpy_policy import numpy_bob
from service.registry.digest import parameters_digest
from service.registry.loading import Trained


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


def test_what_no_composition_does_is_impossible():
    """Two primitives, one moves by +x and one by +y, wherever the object is: they push that way and no other."""
    parameters = dict(Learner(load_config(None, ["policy.bob.num_primitives=2"])).weights().bob)
    parameters["primitives.output_weight"] = np.zeros_like(parameters["primitives.output_weight"])
    bias = np.zeros_like(parameters["primitives.output_bias"])
    bias[0, 0] = bias[1, 1] = 3.0
    parameters["primitives.output_bias"] = bias
    bob = Trained("by hand", "primitives", load_config(), numpy_bob(parameters), parameters)
    found = measure(bob, num_places=7, num_weights=40, seed=0)
    assert found == {"+x": 0.0, "-x": 1.0, "+y": 0.0, "-y": 1.0}


def test_the_champions_recorded_ranges_are_measured_again():
    recorded = json.loads((Path(__file__).parents[2] / "docs" / "results" / "push_range.json").read_text())
    trained = service.load_primitives("panda-cube@champion", registry="no registry here")
    row = recorded["rows"]["panda-cube@seed-0"]  # that is what was shipped
    assert parameters_digest(trained.primitives) == row["digest"]
    assert measure(trained, **recorded["settings"]) == pytest.approx(row["impossible"], abs=0.005)
