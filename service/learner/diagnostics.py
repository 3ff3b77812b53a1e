"""Metrics of an update and of Bob's policy: P probes, K primitives."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from service.learner.group import ALONE, Group, mean_and_std
from service.learner.player import Player
from service.learner.samples import Cloning, Rows
from service.policies import gaussian
from service.policies.networks import MCPPolicy
from service.types import IntArray, Metrics

NUM_PROBES = 1024
"""Number of rows that are enough for what is measured once an update."""


def probes(rows: Rows) -> Rows:
    """The own ones of at most ``NUM_PROBES`` of the rows of all ranks, evenly spread."""
    return rows.find(spread(np.arange(rows.num_total)))


def spread(places: IntArray) -> IntArray:
    """At most ``NUM_PROBES`` of the (N,) places, evenly spread."""
    return places[:: max(1, -(-len(places) // NUM_PROBES))]


def explained_variance(returns: Tensor, values: Tensor, num: int, group: Group = ALONE) -> float:
    """Share of the variance of ``returns`` (N,) that ``values`` predict: 1 at best, 0 for a constant.

    ``num`` rows are those of all ranks together.
    """
    _, std = mean_and_std(returns.double(), num, group)
    _, error_std = mean_and_std((returns - values).double(), num, group)
    return 1.0 - (error_std / std) ** 2 if std > 0.0 else 0.0


def mean_over_ranks(metrics: Metrics, num_rows: int, num_total: int, group: Group) -> Metrics:
    """Average a rank's means over its ``num_rows`` with those of the other ranks, ``num_total`` rows together."""
    weighted = [value * (num_rows / num_total) if num_rows else 0.0 for value in metrics.values()]
    sums = torch.tensor(weighted, dtype=torch.float64)
    group.sum(sums)
    return dict(zip(metrics, sums.tolist(), strict=True))


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
