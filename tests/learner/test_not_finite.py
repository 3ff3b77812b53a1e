"""Whatever is not a number in a rollout: it never reaches parameters, Adam's state or later updates."""

from dataclasses import replace

import numpy as np
import pytest

from service.learner.learner import Learner
from tests.learner.rollouts import make_config, make_rollout

TURNS = ("observation", "value_observation", "final_value_observation", "action", "log_prob", "reward")
FIELDS = [("alice", name) for name in TURNS] + [("bob", name) for name in TURNS]
FIELDS += [("demonstrations", "observation"), ("demonstrations", "action")]


def spoiled(rollout, part, name, value):
    """The rollout with ``value`` in the first place of one of its arrays."""
    array = getattr(getattr(rollout, part), name).copy()
    array.flat[0] = value
    return replace(rollout, **{part: replace(getattr(rollout, part), **{name: array})})


def learn(learner, rollout):
    assert learner.ingest(rollout)
    return learner.update()


def not_finite(learner):
    return [name for name, array in learner.state().items() if array.dtype.kind == "f" and not np.isfinite(array).all()]


@pytest.mark.parametrize(("part", "name"), FIELDS, ids=["/".join(each) for each in FIELDS])
def test_parameters_stay_finite_and_the_next_rollout_is_learned_from(part, name):
    learner = Learner(make_config())
    learn(learner, make_rollout(learner, 0))
    for number, value in enumerate((np.nan, -np.inf, 3e38), start=1):
        with np.errstate(all="ignore"):
            learn(learner, spoiled(make_rollout(learner, number), part, name, value))
        assert not_finite(learner) == [], value
    before = learner.weights()
    metrics = learn(learner, make_rollout(learner, 4))
    assert (metrics["learner/non_finite_steps"], metrics["learner/rollbacks"]) == (0.0, 0.0)
    after = learner.weights()
    for player in ("alice", "bob"):
        pairs = [(getattr(before, player)[key], array) for key, array in getattr(after, player).items()]
        assert any(not np.array_equal(*pair) for pair in pairs), player


@pytest.mark.parametrize(("player", "other"), [("alice", "bob"), ("bob", "alice")])
def test_a_reward_that_is_not_a_number_undoes_that_players_update_only(player, other):
    """Advantages are normalised together, so one of them spoils all."""
    learner = Learner(make_config())
    learn(learner, make_rollout(learner, 0))
    before = learner.state()
    metrics = learn(learner, spoiled(make_rollout(learner, 1), player, "reward", np.nan))
    assert metrics["learner/rollbacks"] == 1.0
    after = learner.state()
    changed = {name for name, array in before.items() if not np.array_equal(array, after[name])}
    assert {name for name in changed if name.startswith(player)} == {f"{player}/learning_rate"}
    assert any(name.startswith(f"{other}/adam/step/") for name in changed)
