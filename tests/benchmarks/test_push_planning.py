from dataclasses import replace

import numpy as np

import service
from benchmarks.push_planning import Settings, measure
from service.config import load_config
from service.learner.learner import Learner
from service.policies.numpy_policy import numpy_bob
from service.registry.digest import parameters_digest
from service.registry.loading import Trained

SMALL = Settings((), num_goals=2, goals_at_once=2, num_plans=24, num_elites=5, num_rounds=5, seed=1)


def still_bob():
    """Two primitives that never move."""
    parameters = dict(Learner(load_config(None, ["policy.bob.num_primitives=2"])).weights().bob)
    for name in ("primitives.output_weight", "primitives.output_bias"):
        parameters[name] = np.zeros_like(parameters[name])
    return Trained("by hand", "primitives", load_config(), numpy_bob(parameters), parameters)


def test_plans_reach_goals_with_primitives_that_push_and_none_with_those_that_rest():
    champion = service.load_primitives("panda-cube@champion")
    before = parameters_digest(champion.primitives)
    assert measure(champion, SMALL)["reached"] >= 0.5
    assert parameters_digest(champion.primitives) == before
    found = measure(still_bob(), replace(SMALL, num_rounds=1))
    assert found["reached"] == 0.0
    assert found["low"] == 0.0
    assert 0.6 < found["high"] < 0.7  # Wilson, 0 of 2


def test_no_more_goals_count_than_were_asked_for():
    settings = Settings((), num_goals=3, goals_at_once=2, num_plans=2, num_elites=1, num_rounds=1)
    assert measure(still_bob(), settings)["reached"] in (0.0, 1 / 3)
