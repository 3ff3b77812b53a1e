"""Metrics of an update and of Bob's policy: P probes, K primitives."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from service.base.types import IntArray
from service.learner.player import Player
from service.learner.samples import Cloning
from service.policies import gaussian
from service.policies.networks import MCPPolicy

NUM_PROBES = 1024
"""Number of rows that are enough for what is measured once an update."""


def probes(num: int) -> IntArray:
    """At most ``NUM_PROBES`` of the places of ``num`` rows, evenly spread."""
    return np.arange(0, num, max(1, -(-num // NUM_PROBES)))


def mean_and_std(values: Tensor) -> tuple[float, float]:
    """Mean and standard deviation of (N,) values."""
    mean = float(values.sum()) / len(values)
    return mean, math.sqrt(float((values - mean).square().sum()) / len(values))


def explained_variance(returns: Tensor, values: Tensor) -> float:
    """Share of the variance of ``returns`` (N,) that ``values`` predict: 1 at best, 0 for a constant."""
    _, std = mean_and_std(returns.double())
    _, error_std = mean_and_std((returns - values).double())
    return 1.0 - (error_std / std) ** 2 if std > 0.0 else 0.0


@torch.no_grad()
def composition_metrics(bob: MCPPolicy, observation: Tensor) -> dict[str, float]:
    """Mean composite std, and each primitive's mean gate weight and mean share of the precision ``w_k / variance_k``.

    Args:
        bob: the policy.
        observation: (P, O).
    """
    weights = bob.gate(observation)
    _, variances = bob.primitives(observation[:, : bob.num_positions])
    precisions = weights[..., None] / variances
    total = precisions.sum(1, keepdim=True)
    metrics = {"bob_std": float(total.rsqrt().mean())}
    shares = (precisions / total).mean((0, 2)).tolist()
    for index, (weight, share) in enumerate(zip(weights.mean(0).tolist(), shares, strict=True)):
        metrics |= {f"primitive_weight_{index}": weight, f"primitive_share_{index}": share}
    return metrics


@torch.no_grad()
def cloning_metrics(player: Player, demonstrations: Cloning) -> dict[str, float]:
    """Mean log-probability of the demonstrations, in nats, and its change by this update."""
    log_prob = player.log_prob(demonstrations.observation, demonstrations.action)
    log_ratio = gaussian.log_ratio(log_prob, demonstrations.proximal_log_prob)
    return {"demonstration_log_prob": float(log_prob.mean()), "demonstration_log_ratio": float(log_ratio.mean())}
