"""Lipschitz-constrained skill discovery."""

from __future__ import annotations

from torch import nn
from torch.nn.utils.parametrizations import spectral_norm
from typing_extensions import override

from service.methods.intrinsic_reward import IntrinsicReward


class LSD(IntrinsicReward):
    """``(phi(s') - phi(s)) . z`` with a phi that is 1-Lipschitz (Park et al. 2022, arXiv 2202.00914).

    Every layer's spectral norm is 1, and so is the greatest slope of ReLU.
    """

    @override
    def make_network(self) -> nn.Module:
        network = super().make_network()
        for layer in network.children():
            if isinstance(layer, nn.Linear):
                spectral_norm(layer)
        return network
