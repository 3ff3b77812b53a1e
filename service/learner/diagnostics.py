"""What Bob's policy looks like from inside: how wide it is and which primitives it uses. P probes, K primitives."""

from __future__ import annotations

import torch
from torch import Tensor

from service.envs.observations import POSITIONS_SIZE
from service.learner import losses
from service.learner.player import Player
from service.learner.samples import Cloning
from service.policies.networks import MCPPolicy


@torch.no_grad()
def composition_metrics(bob: MCPPolicy, observation: Tensor) -> dict[str, float]:
    """Mean composite std, and each primitive's mean gate weight and mean share of the precision ``w_k / variance_k``.

    Args:
        bob: the policy.
        observation: (P, O).
    """
    weights = bob.gate(observation)
    _, variances = bob.primitives(observation[:, :POSITIONS_SIZE])
    precisions = weights[..., None] / variances
    total = precisions.sum(1, keepdim=True)
    metrics = {"bob_std": float(total.rsqrt().mean())}
    shares = (precisions / total).mean((0, 2)).tolist()
    for index, (weight, share) in enumerate(zip(weights.mean(0).tolist(), shares, strict=True)):
        metrics |= {f"primitive_weight_{index}": weight, f"primitive_share_{index}": share}
    return metrics


@torch.no_grad()
def cloning_metrics(bob: Player, demonstrations: Cloning) -> dict[str, float]:
    """How likely the demonstrations became under the policy, in nats, and by how much that changed in this update."""
    log_prob = bob.log_prob(demonstrations.observation, demonstrations.action)
    log_ratio = losses.bounded_log_ratio(log_prob, demonstrations.old_log_prob)
    return {"demonstration_log_prob": float(log_prob.mean()), "demonstration_log_ratio": float(log_ratio.mean())}
