"""The intrinsic rewards of the skill-discovery baselines, and the networks that they come from.

All see transitions of the object's position alone, the prior of the paper: s before and s' after a step, (B, S) each,
and the skill z (B, Z) that acted. ``learn`` improves the network, ``rewards`` says what a transition is worth by it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.parametrizations import spectral_norm

from service.base.types import Array, Arrays, FloatArray
from service.config.skills import SkillMethod, SkillsConfig
from service.learner.sac import ADAM_EPSILON
from service.learner.sac_networks import make_layers
from service.policies.adam import Adam, copied, put_back

_CLIP = 50.0
"""Of the difference of two log-probabilities of DADS (its code)."""
_MOMENT_DECAY = 0.99
"""Weight that a batch's moments keep from one update to the next, in DADS' normalisation."""


class IntrinsicReward:
    """A reward that a network makes out of transitions and skills.

    Args:
        config: of the method.
        state_size: S.
        seed: of the network's first parameters, and of what it draws.
    """

    pays_jumps = True
    """Whether it pays the way from any state to any other, not only what a step of the world can be."""

    def __init__(self, config: SkillsConfig, state_size: int, seed: int) -> None:
        self.config, self.state_size = config, state_size
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = self._make_network().eval()
        self._random = torch.Generator().manual_seed(seed)
        self._optimizer = Adam(self._learned(), config.learning_rate, epsilon=ADAM_EPSILON)

    def learn(self, before: Tensor, after: Tensor, skill: Tensor) -> float:
        """Make one gradient step; returns the loss before it."""
        self.network.train()  # where spectral norms are estimated, this goes on with that
        loss = self._loss(before, after, skill)
        self.network.eval()
        parameters = list(self._learned().values())
        for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            parameter.grad = gradient
        self._optimizer.step()
        return loss.item()

    @torch.no_grad()
    def rewards(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        """(B,) rewards, not scaled."""
        return self._rewards(before, after, skill)

    def exported(self) -> dict[str, FloatArray]:
        """The network's parameters as float32 copies by name, as plain layers have them."""
        linear = [layer for layer in self.network.children() if isinstance(layer, nn.Linear)]
        names = {f"{2 * place}": layer for place, layer in enumerate(linear)}
        parts = {f"{name}.weight": layer.weight for name, layer in names.items()}
        parts |= {f"{name}.bias": layer.bias for name, layer in names.items()}
        return {name: tensor.detach().numpy().astype(np.float32) for name, tensor in parts.items()}

    def state(self) -> Arrays:
        """Everything that ``load_state`` continues from, copied."""
        return copied(self._tensors()) | {"random": self._random.get_state().numpy().copy()}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Continue, bit for bit, where ``state`` was taken by a reward of the same settings."""
        put_back(state, self._tensors())
        self._random.set_state(torch.from_numpy(np.array(state["random"])))

    def _make_network(self) -> nn.Module:
        return make_layers(self.state_size, *self.config.hidden_sizes, self.config.size)

    def _loss(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        return -self._rewards(before, after, skill).mean()

    def _rewards(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        """The way in phi along the skill, as LSD and METRA pay it."""
        return _along(self.network(after) - self.network(before), skill)

    def _learned(self) -> dict[str, Tensor]:
        return dict(self.network.named_parameters())

    def _tensors(self) -> dict[str, Tensor]:
        parts = {"network": self.network.state_dict(keep_vars=True), "adam": self._optimizer.tensors()}
        return {f"{part}/{name}": tensor for part, tensors in parts.items() for name, tensor in tensors.items()}


class LSD(IntrinsicReward):
    """``(phi(s') - phi(s)) . z`` with a phi that is 1-Lipschitz (Park et al. 2022, arXiv 2202.00914).

    Every layer's spectral norm is 1, and so is the greatest slope of ReLU.
    """

    def _make_network(self) -> nn.Module:
        network = super()._make_network()
        for layer in network.children():
            if isinstance(layer, nn.Linear):
                spectral_norm(layer)
        return network


class METRA(IntrinsicReward):
    """As LSD with z on the unit sphere, where a step in phi has a mean square of at most 1 (Park et al. 2024).

    A dual variable holds that constraint (arXiv 2310.08887; the mean over dimensions, as its code has it).
    """

    def __init__(self, config: SkillsConfig, state_size: int, seed: int) -> None:
        self._log_dual = torch.tensor(math.log(config.dual_initial), requires_grad=True)
        super().__init__(config, state_size, seed)

    def _loss(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        step: Tensor = self.network(after) - self.network(before)
        room = (1.0 - step.square().mean(dim=1)).clamp(max=self.config.dual_slack)
        # One gradient step for both: phi goes up on rewards and on room, the dual down where there is room.
        ascent = _along(step, skill) + self._log_dual.exp().detach() * room
        return -ascent.mean() + self._log_dual * room.detach().mean()

    def _learned(self) -> dict[str, Tensor]:
        return super()._learned() | {"log_dual": self._log_dual}

    def _tensors(self) -> dict[str, Tensor]:
        return super()._tensors() | {"log_dual": self._log_dual}


class DIAYN(IntrinsicReward):
    """``log q(z | s') - log p(z)`` with q = N(mu(s'), I) and p = N(0, I) (Eysenbach et al. 2019, continuous z)."""

    def _rewards(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        mean: Tensor = self.network(after)
        return 0.5 * (skill.square() - (skill - mean).square()).sum(dim=1)


class DADS(IntrinsicReward):
    """``log (L + 1) - log(1 + sum_j q(s' | s, z_j) / q(s' | s, z))`` with L skills z_j of the prior.

    Sharma et al. 2020 (arXiv 1907.01657). q is a Gaussian of the normalised change of s with a std of 1; a ratio's
    logarithm is clipped to +- 50.
    """

    pays_jumps = False

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

    def _make_network(self) -> nn.Module:
        return make_layers(self.state_size + self.config.size, *self.config.hidden_sizes, self.state_size)

    def _normalised(self, name: str, values: Tensor) -> Tensor:
        mean, square = self._moments[f"{name}_mean"], self._moments[f"{name}_square"]
        return (values - mean) / (square - mean.square() + self.config.variance_floor).sqrt()

    def _log_prob(self, before: Tensor, change: Tensor, skill: Tensor) -> Tensor:
        """(...,) but for a constant, at normalised (..., S) states and changes and (..., Z) skills."""
        mean: Tensor = self.network(torch.cat((before, skill), dim=-1))
        return -0.5 * (change - mean).square().sum(dim=-1)

    def _loss(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        change = self._normalised("change", after - before)
        return -self._log_prob(self._normalised("before", before), change, skill).mean()

    def _rewards(self, before: Tensor, after: Tensor, skill: Tensor) -> Tensor:
        num = self.config.num_alternatives
        state, change = self._normalised("before", before), self._normalised("change", after - before)
        others = torch.rand((num, self.config.size), generator=self._random) * 2.0 - 1.0  # as of ``frozen.draw_skills``
        own = self._log_prob(state, change, skill)
        states, changes = (each[:, None].expand(-1, num, -1) for each in (state, change))
        other = self._log_prob(states, changes, others.expand(len(state), -1, -1))
        ratios = (other - own[:, None]).clamp(-_CLIP, _CLIP).exp()
        return math.log(num + 1) - torch.log1p(ratios.sum(dim=1))

    def _tensors(self) -> dict[str, Tensor]:
        return super()._tensors() | {f"moments/{name}": each for name, each in self._moments.items()}


def _along(step: Tensor, skill: Tensor) -> Tensor:
    """(B,) length of (B, Z) steps in phi along (B, Z) skills, times the skills' own."""
    return (step * skill).sum(dim=1)


METHODS: Mapping[SkillMethod, type[IntrinsicReward]] = {"lsd": LSD, "diayn": DIAYN, "dads": DADS, "metra": METRA}


def make_reward(config: SkillsConfig, state_size: int, seed: int) -> IntrinsicReward:
    """The reward of the configured method."""
    return METHODS[config.method](config, state_size, seed)
