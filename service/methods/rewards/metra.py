"""Metric-aware abstraction."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor
from typing_extensions import override

from service.config.skills import Prior, SkillsConfig
from service.methods.intrinsic_reward import IntrinsicReward, along

_SLACK = 1e-3
"""Of the constraint (its code)."""


class METRA(IntrinsicReward):
    """As LSD with z on the unit sphere, where a step in phi has a mean square of at most 1 (Park et al. 2024).

    A dual variable holds that constraint (arXiv 2310.08887; the mean over dimensions, as its code has it).
    """

    prior: ClassVar[Prior] = "sphere"

    def __init__(self, config: SkillsConfig, state_size: int, seed: int) -> None:
        self._log_dual = torch.tensor(math.log(config.dual_initial), requires_grad=True)
        super().__init__(config, state_size, seed)

    @override
    def loss(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        step: Tensor = self.network(after) - self.network(before)
        room = (1.0 - step.square().mean(dim=1)).clamp(max=_SLACK)
        # One gradient step for both: phi goes up on rewards and on room, the dual down where there is room.
        ascent = along(step, skill) + self._log_dual.exp().detach() * room
        return -ascent.mean() + self._log_dual * room.detach().mean()

    @override
    def learned(self) -> dict[str, Tensor]:
        return super().learned() | {"log_dual": self._log_dual}

    @override
    def tensors(self) -> dict[str, Tensor]:
        return super().tensors() | {"log_dual": self._log_dual}
