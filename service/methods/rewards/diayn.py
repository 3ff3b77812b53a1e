"""Diversity is all you need."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor
from typing_extensions import override

from service.config.skills import ZeroShot
from service.methods.intrinsic_reward import IntrinsicReward


class DIAYN(IntrinsicReward):
    """``log q(z | s') - log p(z)`` with q = N(mu(s'), I) and p = N(0, I) (Eysenbach et al. 2019, continuous z)."""

    zero_shot: ClassVar[ZeroShot] = "place"

    @override
    def paid(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        mean: Tensor = self.network(after)
        return 0.5 * (skill.square() - (skill - mean).square()).sum(dim=1)
