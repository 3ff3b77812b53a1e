"""The two bounds on pushing: which directions no composition has, and what plans reach."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import push_planning, push_range
from benchmarks.measuring import ROOT
from benchmarks.push_range import DIRECTIONS, best_pushes, positions_behind
from service.config import load_config
from service.learner.learner import Learner
from service.policies.numpy_policy import numpy_bob
from service.registry.loading import Trained, parameters_digest


def two_primitives(*bias):
    """Primitives that do the same wherever the object is: nothing, or what their biases say."""
    parameters = dict(Learner(load_config(None, ["policy.bob.num_primitives=2"])).weights().bob)
    for name in ("primitives.output_weight", "primitives.output_bias"):
        parameters[name] = np.zeros_like(parameters[name])
    for place in bias:
        parameters["primitives.output_bias"][place] = 3.0
    return Trained("by hand", "primitives", load_config(), numpy_bob(parameters), parameters)


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
    """One moves by +x and one by +y: they push that way and no other."""
    found = push_range.measure(two_primitives((0, 0), (1, 1)), num_places=7, num_weights=40, seed=0)
    assert found == {"+x": 0.0, "-x": 1.0, "+y": 0.0, "-y": 1.0}


def test_the_champions_recorded_ranges_are_measured_again(champion):
    recorded = json.loads((ROOT / "docs" / "results" / "push_range.json").read_text())
    row = recorded["rows"]["panda-cube@seed-0"]  # that is what was shipped
    assert parameters_digest(champion.primitives) == row["digest"]
    assert push_range.measure(champion, **recorded["settings"]) == pytest.approx(row["impossible"], abs=0.005)


def test_plans_reach_goals_with_primitives_that_push_and_none_with_those_that_rest(champion):
    small = push_planning.Settings((), num_goals=2, goals_at_once=2, num_plans=24, num_elites=5, num_rounds=5, seed=1)
    before = parameters_digest(champion.primitives)
    assert push_planning.measure(champion, small)["reached"] >= 0.5
    assert parameters_digest(champion.primitives) == before
    found = push_planning.measure(two_primitives(), replace(small, num_rounds=1))
    assert found["reached"] == 0.0
    assert found["low"] == 0.0
    assert 0.6 < found["high"] < 0.7  # Wilson, 0 of 2


def test_no_more_goals_count_than_were_asked_for():
    settings = push_planning.Settings((), num_goals=3, goals_at_once=2, num_plans=2, num_elites=1, num_rounds=1)
    assert push_planning.measure(two_primitives(), settings)["reached"] in (0.0, 1 / 3)
