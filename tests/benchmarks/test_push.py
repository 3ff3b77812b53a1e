"""What plans of compositions reach: a lower bound of what frozen primitives can push."""

from dataclasses import replace

import numpy as np

from benchmarks import push_planning
from service.config import load_config
from service.learner.learner import Learner
from service.policies.numpy_policy import numpy_bob
from service.registry.loading import Trained, parameters_digest


def two_primitives():
    """Primitives that do nothing, wherever the object is."""
    parameters = dict(Learner(load_config(None, ["policy.bob.num_primitives=2"])).weights().bob)
    for name in ("primitives.output_weight", "primitives.output_bias"):
        parameters[name] = np.zeros_like(parameters[name])
    return Trained("by hand", "primitives", load_config(), numpy_bob(parameters), parameters)


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
