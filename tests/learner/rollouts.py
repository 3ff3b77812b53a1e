"""Small synthetic rollouts, and small networks to learn from them."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from service.actors.rollout import Demonstrations, Rollout, Turns
from service.config import Config, parse_config
from service.envs.observations import ACTION, BOB, PAPER
from service.learner.learner import Learner
from service.learner.player import Player
from tests.generator.outcomes import make_records

DEVICE = torch.device(os.environ.get("TANDEM_TEST_DEVICE", "cpu"))
"""The device that learners of these tests learn on."""
NUM_STEPS, NUM_WORLDS = 6, 8
_SMALL = {"hidden_sizes": [16]}
_SMALL_MCP = {"num_primitives": 2, "trunk_hidden_sizes": [16], "primitive_hidden_size": 8, "gate_hidden_sizes": [16]}


def make_config(alice: dict[str, Any] | None = None, bob: dict[str, Any] | None = None, **learner: Any) -> Config:
    """Networks of a few neurons; minibatches smaller than a rollout."""
    tree = {
        "policy": {"alice": _SMALL, "bob": _SMALL_MCP, "value": _SMALL},
        "learner": {
            "alice": {"num_epochs": 2, "minibatch_size": 16, **(alice or {})},
            "bob": {"num_epochs": 2, "minibatch_size": 8, **(bob or {})},
            "device": DEVICE.type,
            **learner,
        },
    }
    return parse_config(tree, where="a test")


def make_turns(rng: np.random.Generator, observation_size: int, value_size: int, **overrides: Any) -> Turns:
    """Turns of unequal length; some terminated, with a reward."""
    shape = NUM_STEPS, NUM_WORLDS
    lengths = rng.integers(1, NUM_STEPS + 1, NUM_WORLDS)
    steps = np.arange(NUM_STEPS)[:, None]
    terminated = (steps == lengths - 1) & (rng.random(NUM_WORLDS) < 0.5)
    turns = Turns(
        observation=_normal(rng, 0.1, *shape, observation_size),
        value_observation=_normal(rng, 0.1, *shape, value_size),
        final_value_observation=_normal(rng, 0.1, NUM_WORLDS, value_size),
        action=_normal(rng, 0.7, *shape, ACTION.size),
        log_prob=_normal(rng, 0.01, *shape),
        reward=terminated.astype(np.float32),
        active=steps < lengths,
        terminated=terminated,
        learn=np.ones(NUM_WORLDS, dtype=np.bool_),
    )
    return replace(turns, **overrides)


def make_rollout(learner: Learner, sequence: int, *, seed: int = 0, num_demonstrations: int = 12) -> Rollout:
    """A rollout whose actions the learner's present policies could have drawn."""
    rng = np.random.default_rng([seed, sequence])
    alice = make_turns(rng, PAPER.full.size, PAPER.full.size)
    bob = make_turns(rng, BOB.size, PAPER.bob_value.size)
    return Rollout(
        actor=0,
        incarnation=0,
        sequence=sequence,
        policy_version=learner.version,
        alice=acted_by(learner._alice, alice),
        bob=acted_by(learner._bob, bob),
        demonstrations=make_demonstrations(rng, num_demonstrations),
        records=_NO_RECORDS,
        num_env_steps=0,
        metrics={},
    )


def make_demonstrations(rng: np.random.Generator, num: int) -> Demonstrations:
    return Demonstrations(_normal(rng, 0.1, num, BOB.size), _normal(rng, 0.3, num, ACTION.size))


def acted_by(player: Player, turns: Turns) -> Turns:
    """The same turns with the player's own log-probabilities."""
    acted = (torch.from_numpy(each).to(player.device) for each in (turns.observation, turns.action))
    with torch.no_grad():
        log_prob = player.log_prob(*acted)
    return replace(turns, log_prob=log_prob.cpu().numpy())


def nobody_learns(turns: Turns) -> Turns:
    """Turns of past opponents only."""
    return replace(turns, learn=np.zeros(NUM_WORLDS, dtype=np.bool_))


def _normal(rng: np.random.Generator, scale: float, *shape: int) -> np.ndarray:
    return (scale * rng.standard_normal(shape)).astype(np.float32)


_NO_RECORDS = make_records(np.zeros((0, 3)))
