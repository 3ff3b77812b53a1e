"""Dynamics-aware discovery of skills."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor, nn
from typing_extensions import override

from service.config.skills import Prior, SkillsConfig, ZeroShot
from service.learner.sac_networks import make_layers
from service.methods.intrinsic_reward import IntrinsicReward

_CLIP = 50.0
"""Of the difference of two log-probabilities (its code)."""
_MOMENT_DECAY = 0.99
"""Weight that a batch's moments keep from one update to the next, in the normalisation."""
_VARIANCE_FLOOR = 1e-3
"""Added to the variances by which it normalises, as its code's batch normalisation does."""
_AT_ONCE = 32
"""Transitions whose alternatives are predicted at once: with those of a whole batch the layers' outputs leave the
processor's cache, and take almost three times as long."""


class DADS(IntrinsicReward):
    """``log (L + 1) - log(1 + sum_j q(s' | s, z_j) / q(s' | s, z))`` with L skills z_j of the prior.

    Sharma et al. 2020 (arXiv 1907.01657). q is a Gaussian of the normalised change of s with a std of 1; a ratio's
    logarithm is clipped to +- 50.
    """

    prior: ClassVar[Prior] = "uniform"
    zero_shot: ClassVar[ZeroShot] = "none"
    pays_jumps: ClassVar[bool] = False

    def __init__(self, config: SkillsConfig, state_size: int, seed: int) -> None:
        super().__init__(config, state_size, seed)
        self._moments = {name: torch.zeros(state_size) for name in ("before_mean", "change_mean")}
        self._moments |= {name: torch.ones(state_size) for name in ("before_square", "change_square")}

    def learn(self, before: Tensor, after: Tensor, skill: Tensor) -> float:
        """Move the normalisation towards this batch's moments, then make one gradient step."""
        for name, values in {"before": before, "change": after - before}.items():
            self._moments[f"{name}_mean"].lerp_(values.mean(0), 1.0 - _MOMENT_DECAY)
            self._moments[f"{name}_square"].lerp_(values.square().mean(0), 1.0 - _MOMENT_DECAY)
        return super().learn(before, after, skill)

    @override
    def make_network(self) -> nn.Module:
        return make_layers(self.state_size + self.config.size, *self.config.hidden_sizes, self.state_size)

    def _normalised(self, name: str, values: Tensor) -> Tensor:
        mean, square = self._moments[f"{name}_mean"], self._moments[f"{name}_square"]
        return (values - mean) / (square - mean.square() + _VARIANCE_FLOOR).sqrt()

    def _log_prob(self, before: Tensor, change: Tensor, skill: Tensor) -> Tensor:
        """(...,) but for a constant, at normalised (..., S) states and changes and (..., Z) skills."""
        mean: Tensor = self.network(torch.cat((before, skill), dim=-1))
        return -0.5 * (change - mean).square().sum(dim=-1)

    def _log_prob_of_each(self, before: Tensor, change: Tensor, skills: Tensor) -> Tensor:
        """(B, L) of the same for each of (L, Z) skills, at (B, S) states and changes."""
        states, changes = (each[:, None].expand(-1, len(skills), -1) for each in (before, change))
        return self._log_prob(states, changes, skills.expand(len(before), -1, -1))

    @override
    def loss(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        change = self._normalised("change", after - before)
        return -self._log_prob(self._normalised("before", before), change, skill).mean()

    @override
    def paid(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        num = self.config.num_alternatives
        state, change = self._normalised("before", before), self._normalised("change", after - before)
        others = torch.rand((num, self.config.size), generator=self._random) * 2.0 - 1.0  # as of its prior
        own = self._log_prob(state, change, skill)
        parts = zip(state.split(_AT_ONCE), change.split(_AT_ONCE), strict=True)
        other = torch.cat([self._log_prob_of_each(*part, others) for part in parts])
        ratios = (other - own[:, None]).clamp(-_CLIP, _CLIP).exp()
        return math.log(num + 1) - torch.log1p(ratios.sum(dim=1))

    @override
    def tensors(self) -> dict[str, Tensor]:
        return super().tensors() | {f"moments/{name}": each for name, each in self._moments.items()}
