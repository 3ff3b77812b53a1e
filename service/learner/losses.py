"""The learner's losses as pure functions of (B,) tensors, each a mean to be minimised."""

from __future__ import annotations

import torch
from torch import Tensor

LOG_RATIO_BOUND = 20.0
"""Log-ratios are clamped to +- this: the ratio of two products of experts can overflow float32 otherwise."""

LAG_WEIGHT_BOUND = 2.0
"""Of the importance weight that corrects for policy lag: a bound on variance, at the price of a little bias."""


def bounded_log_ratio(log_prob: Tensor, old_log_prob: Tensor) -> Tensor:
    """``log_prob - old_log_prob`` within +- ``LOG_RATIO_BOUND``; no gradient flows beyond it."""
    return (log_prob - old_log_prob).clamp(-LOG_RATIO_BOUND, LOG_RATIO_BOUND)


def clipped_surrogate(
    log_prob: Tensor, old_log_prob: Tensor, advantage: Tensor, clip: float, dual_clip: float
) -> tuple[Tensor, Tensor]:
    """PPO's clipped surrogate (Schulman et al. 2017, eq. 7) with the dual clip of Ye et al. (2020, eq. 5).

    The dual clip bounds the objective of a negative advantage from below by ``dual_clip * advantage``, so a single
    action that became far more likely cannot dominate the batch.

    Args:
        log_prob: of the actions under the policy that learns.
        old_log_prob: of the same under the policy that acted.
        advantage: normalised.
        clip: epsilon.
        dual_clip: greater than 1.

    Returns:
        The loss, and the share of ratios outside ``1 +- clip`` (no gradient).
    """
    ratio = bounded_log_ratio(log_prob, old_log_prob).exp()
    objective = torch.minimum(ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage)
    bounded = torch.where(advantage < 0.0, torch.maximum(objective, dual_clip * advantage), objective)
    clip_fraction = ((ratio.detach() - 1.0).abs() > clip).float().mean()
    return -bounded.mean(), clip_fraction


def lag_weight(start_log_prob: Tensor, old_log_prob: Tensor) -> Tensor:
    """Importance weight of actions from a policy that is a version or two behind, at most ``LAG_WEIGHT_BOUND``."""
    return bounded_log_ratio(start_log_prob, old_log_prob).exp().clamp(max=LAG_WEIGHT_BOUND)


def cloning_loss(log_prob: Tensor, old_log_prob: Tensor, clip: float) -> Tensor:
    """Alice behavioural cloning (OpenAI 2021): the clipped surrogate with advantage 1, ``-mean(min(ratio, 1 + clip))``.

    An action that is already ``1 + clip`` times likelier than at the start of the update has no gradient.
    """
    return -bounded_log_ratio(log_prob, old_log_prob).exp().clamp(max=1.0 + clip).mean()


def value_loss(value: Tensor, target: Tensor) -> Tensor:
    """Half the mean squared error."""
    return 0.5 * (value - target).square().mean()
