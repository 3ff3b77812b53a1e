"""Contrastive successor features."""

from __future__ import annotations

import math
from typing import ClassVar

from torch import Tensor
from typing_extensions import override

from service.config.skills import Prior
from service.methods.intrinsic_reward import IntrinsicReward, along

_CONTRAST = 5.0
"""Weight of the contrast with other skills (xi in the paper)."""


class CSF(IntrinsicReward):
    """Features ``phi(s') - phi(s)``, paid as their product with z (Zheng et al. 2025, arXiv 2412.08021).

    phi learns to tell which skill of a batch made a step: with d = phi(s') - phi(s), it makes
    ``d . z - xi log mean_j exp(d . z_j)`` large. Nothing else bounds it. Critics learn successor features, whose
    product with z is the value.
    """

    prior: ClassVar[Prior] = "sphere"
    pays_features: ClassVar[bool] = True

    @override
    def loss(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        step = self.paid(before, after, skill)
        others = (step @ skill.T).logsumexp(dim=1) - math.log(len(skill))
        return (_CONTRAST * others - along(step, skill)).mean()

    @override
    def paid(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        step: Tensor = self.network(after) - self.network(before)
        return step
