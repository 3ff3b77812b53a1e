"""Diagonal Gaussians over actions, in torch. B batch axes (any number), A action components."""

from __future__ import annotations

import math

from torch import Tensor

MAX_LOG_RATIO = 20.0
"""Log-ratios are clamped to +- this: the ratio of two products of experts can overflow float32 otherwise."""


def log_prob(action: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Log density (B,) of (B, A) actions."""
    standardised = (action - mean) / std
    return -(0.5 * standardised.square() + std.log() + 0.5 * math.log(2.0 * math.pi)).sum(-1)


def log_ratio(log_prob0: Tensor, log_prob1: Tensor) -> Tensor:
    """Log of the ratio of two policies' densities (B,), within +- ``MAX_LOG_RATIO``; no gradient flows beyond it."""
    return (log_prob0 - log_prob1).clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO)


def entropy(std: Tensor) -> Tensor:
    """Differential entropy (B,) in nats."""
    return (std.log() + 0.5 * math.log(2.0 * math.pi * math.e)).sum(-1)


def kl(mean0: Tensor, std0: Tensor, mean1: Tensor, std1: Tensor) -> Tensor:
    """KL divergence (B,) in nats of distribution 0 from distribution 1, ``KL(0 || 1)``."""
    ratio = (std0 / std1).square()
    shift = ((mean0 - mean1) / std1).square()
    return 0.5 * (ratio + shift - 1.0 - ratio.log()).sum(-1)
