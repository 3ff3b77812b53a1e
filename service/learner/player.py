"""One player's networks and optimiser, with everything about them that a resumed run needs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

from service.base.tensors import join_parts
from service.base.types import Array, Arrays
from service.config.self_play import PPOConfig
from service.policies import gaussian
from service.policies.adam import Adam, copied, put_back

ADAM_EPSILON = 1e-5
LEARNING_RATE_BOUNDS = 0.03, 2.0
"""The KL-adaptive learning rate stays within these multiples of the configured one."""


class Player:
    """A policy and its value network under one Adam."""

    def __init__(self, policy: nn.Module, value: nn.Module, config: PPOConfig, device: torch.device) -> None:
        """Take both networks to ``device``; from now on only this player may change them."""
        self.policy, self.value, self.config, self.device = policy.to(device), value.to(device), config, device
        networks = {"policy": self.policy, "value": self.value}
        self._parameters = {
            f"{key}/{name}": each for key, network in networks.items() for name, each in network.named_parameters()
        }
        self.policy_parameters, self.value_parameters = list(policy.parameters()), list(value.parameters())
        self.optimizer = Adam(self._parameters, config.learning_rate, epsilon=ADAM_EPSILON)

    def log_prob(self, observation: Tensor, action: Tensor) -> Tensor:
        """Log-probabilities (B,) of (B, A) actions at (B, O) observations."""
        return gaussian.log_prob(action, *self.policy(observation))

    def state(self) -> Arrays:
        """Copy everything that changes: parameters, Adam's state, learning rate."""
        rates = {"learning_rate": self.optimizer.learning_rate, "configured_rate": self.config.learning_rate}
        return copied(self.tensors()) | {name: np.array(rate) for name, rate in rates.items()}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Continue exactly where ``state`` was taken, by a player of the same configuration.

        Where another learning rate is configured by now, the saved one, which has followed the KL divergence, changes
        in the same proportion.
        """
        put_back(state, self.tensors())
        now = self.config.learning_rate
        rate = float(state["learning_rate"])
        if (before := float(state.get("configured_rate", now))) != now:  # checkpoints of before do not say
            rate *= now / before
        low, high = (now * bound for bound in LEARNING_RATE_BOUNDS)
        self.optimizer.learning_rate = min(max(rate, low), high)

    def tensors(self) -> dict[str, Tensor]:
        """Parameters and Adam's state by name: the tensors themselves, always in the same order."""
        return self._parameters | join_parts({"adam": self.optimizer.tensors()})
