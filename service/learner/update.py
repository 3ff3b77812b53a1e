"""A player's whole update: train, measure how far the policy moved, adapt the learning rate, undo what went wrong."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from service.config import ABCConfig
from service.learner.player import RATE_BOUNDS, Player
from service.learner.returns import explained_variance
from service.learner.samples import Cloning, Samples
from service.learner.training import train
from service.policies import gaussian

RATE_STEP = 1.5
"""The KL-adaptive learning rate moves by this factor (rsl_rl)."""
COLLAPSE_KL = 10.0
"""An update that moved the policy by more than this multiple of the target KL is undone."""
NUM_PROBES = 1024
"""So many rows are enough for what is measured once an update."""


def update_player(
    player: Player, samples: Samples | None, cloning: Cloning | None, abc: ABCConfig, rng: np.random.Generator
) -> dict[str, float]:
    """Learn from samples, demonstrations or both; go back to the last good state, this update's first, if that fails.

    An update fails when three minibatches were not finite, or when it moved the policy by ten times the target KL.
    The KL is exact, between the policies before and after, averaged over probes.

    Returns:
        Metrics without the player's prefix; one that there is nothing to measure on is left out.
    """
    metrics = {"learning_rate": player.optimizer.learning_rate, "non_finite_steps": 0.0, "rollbacks": 0.0}
    rows = samples if samples is not None else cloning
    if rows is None:
        return metrics
    snapshot, observation = player.snapshot(), probes(rows.observation)
    with torch.no_grad():
        before = player.policy(observation)
    tally = train(player, samples, cloning, abc, rng)
    with torch.no_grad():
        kl = float(gaussian.kl(*before, *player.policy(observation)).mean())
    failed = tally.aborted or not kl <= COLLAPSE_KL * player.config.target_kl
    if failed:
        player.restore(snapshot)
    player.optimizer.learning_rate = _adapted(player, math.inf if failed or tally.stopped else kl)
    if samples is not None:
        metrics["explained_variance"] = explained_variance(samples.target.cpu().numpy(), samples.value.cpu().numpy())
    metrics |= {"non_finite_steps": float(tally.num_non_finite), "rollbacks": float(failed)}
    metrics["policy_steps"] = float(max(len(tally.terms.get(name, ())) for name in ("policy_loss", "cloning_loss")))
    return metrics | tally.means() | {"kl": kl}


def probes(rows: Tensor) -> Tensor:
    """At most ``NUM_PROBES`` of the rows, evenly spread."""
    return rows[:: -(-len(rows) // NUM_PROBES)]


def _adapted(player: Player, kl: float) -> float:
    """A lower learning rate after an update that moved too far, a higher one after one that hardly moved.

    One that was stopped early moved too far as well, whatever its KL: its step was so long that most of what was
    played was not learned from.
    """
    low, high = (player.config.learning_rate * bound for bound in RATE_BOUNDS)
    if kl > 2.0 * player.config.target_kl:
        return max(player.optimizer.learning_rate / RATE_STEP, low)
    if kl < 0.5 * player.config.target_kl:
        return min(player.optimizer.learning_rate * RATE_STEP, high)
    return player.optimizer.learning_rate
