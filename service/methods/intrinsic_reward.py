"""An intrinsic reward: what teaches a policy that a skill steers, and the network that it comes from.

All see transitions of the object's position alone, the prior of the paper: s before and s' after a step, (B, S) each,
and the skill z (B, Z) that acted. ``rewards/`` has ours, a file each; a user's own is a class like them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from service.base.tensors import join_parts
from service.base.types import Array, Arrays, FloatArray
from service.config.skills import Prior, SkillsConfig, ZeroShot
from service.learner.sac import ADAM_EPSILON
from service.learner.sac_networks import make_layers
from service.policies.adam import Adam, copied, put_back


class IntrinsicReward:
    """The base class of intrinsic rewards, which a network computes from transitions and skills.

    A method has its own ``loss`` or ``paid``.

    Args:
        config: of the method.
        state_size: S.
        seed: of the network's first parameters, and of what it draws.
    """

    prior: ClassVar[Prior] = "normal"
    """Where skills are drawn from: N(0, I), uniform on the unit sphere, or uniform in [-1, 1]."""
    zero_shot: ClassVar[ZeroShot] = "way"
    """The skill that leads to a goal: the way to it in the network's outputs, the outputs there, or none."""
    pays_jumps: ClassVar[bool] = True
    """Whether it pays the way from any state to any other, not only what a step of the world can be."""
    pays_features: ClassVar[bool] = False
    """Whether ``paid`` is (B, Z). What is paid is then its product with z, and the critics have Z outputs."""

    def __init__(self, config: SkillsConfig, state_size: int, seed: int) -> None:
        self.config, self.state_size = config, state_size
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = self.make_network().eval()
        self._random = torch.Generator().manual_seed(seed)
        self._optimizer = Adam(self.learned(), config.learning_rate, epsilon=ADAM_EPSILON)

    def learn(self, before: Tensor, after: Tensor, skill: Tensor) -> float:
        """Make one gradient step; returns the loss before it."""
        self.network.train()  # where spectral norms are estimated, this goes on with that
        loss = self.loss(before, after, skill)
        self.network.eval()
        self._optimizer.descend(loss)
        return loss.item()

    @torch.no_grad()
    def rewards(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        """(B,) rewards, or (B, Z) features, not scaled."""
        return self.paid(before, after, skill)

    def exported(self) -> dict[str, FloatArray]:
        """The network's parameters as float32 copies by name, as plain layers have them."""
        linear = [layer for layer in self.network.children() if isinstance(layer, nn.Linear)]
        names = {f"{2 * place}": layer for place, layer in enumerate(linear)}
        parts = {f"{name}.weight": layer.weight for name, layer in names.items()}
        parts |= {f"{name}.bias": layer.bias for name, layer in names.items()}
        return {name: tensor.detach().numpy().astype(np.float32) for name, tensor in parts.items()}

    def state(self) -> Arrays:
        """Everything that ``load_state`` continues from, copied."""
        return copied(self.tensors()) | {"random": self._random.get_state().numpy().copy()}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Continue, bit for bit, where ``state`` was taken by a reward of the same settings."""
        put_back(state, self.tensors())
        self._random.set_state(torch.from_numpy(np.array(state["random"])))

    def make_network(self) -> nn.Module:
        """The network; layers of ``torch.nn.Linear`` with ReLU between them can be exported."""
        return make_layers(self.state_size, *self.config.hidden_sizes, self.config.size)

    def loss(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        """Scalar loss of the network on (B, S) states before and after, and (B, Z) skills."""
        return -self.paid(before, after, skill).mean()

    def paid(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        """(B,) rewards (phi(s') - phi(s)) . z, as of LSD and METRA; (B, Z) with ``pays_features``."""
        return along(self.network(after) - self.network(before), skill)

    def learned(self) -> dict[str, Tensor]:
        """Parameters that ``loss`` moves, by name."""
        return dict(self.network.named_parameters())

    def tensors(self) -> dict[str, Tensor]:
        """Everything that changes but random numbers, by name: the tensors themselves."""
        parts = {"network": self.network.state_dict(keep_vars=True), "adam": self._optimizer.tensors()}
        return join_parts(parts)


def along(step: Tensor, skill: Tensor) -> Tensor:
    """(B,) dot products of (B, Z) steps in phi and (B, Z) skills."""
    return (step * skill).sum(dim=1)
