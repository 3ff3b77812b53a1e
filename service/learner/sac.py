"""Soft actor-critic: an actor, two critics and an entropy coefficient, learned from batches of transitions.

Haarnoja et al. 2018 (arXiv 1812.05905). No episode ends but by time, so every target looks
beyond its transition. The actor that is evaluated and exported is an average of those of the last iterations, as Bob's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from service.base.tensors import join_parts
from service.base.types import Array, Arrays, FloatArray, Metrics
from service.config.skills import SACConfig
from service.learner.sac_networks import Critics, sample_actions
from service.policies.adam import Adam, copied, put_back
from service.policies.networks import export_parameters

ADAM_EPSILON = 1e-8


class Batch(NamedTuple):
    """B transitions."""

    inputs: FloatArray
    """(B, I)"""
    actions: FloatArray
    """(B, A) in [-1, 1]."""
    rewards: FloatArray
    """(B,), or (B, F) features."""
    next_inputs: FloatArray
    """(B, I)"""
    weights: FloatArray | None = None
    """(B, F) of the features: their product is what is paid."""


@contextmanager
def wide_products() -> Iterator[None]:
    """Multiply float32 matrices by oneDNN where that is faster: on processors with AVX-512 and without AMX.

    torch multiplies by MKL, which leaves half of the width of AMD's vectors unused: with oneDNN these learners make 1.4
    times the env steps/s on Zen 5. torch has no other switch for it than to allow bfloat16. oneDNN rounds to that where
    the processor has AMX, so not there.
    """
    products = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]
    before = products.fp32_precision
    if torch.cpu._is_avx512_supported() and not torch.cpu._is_amx_tile_supported():
        products.fp32_precision = "bf16"
    try:
        yield
    finally:
        products.fp32_precision = before


class SACLearner:
    """Learns an actor; the same batches give the same actor, whatever else draws random numbers.

    Args:
        actor: gives mean and log-std, (N, A) each, before the tanh.
        num_inputs: I.
        num_actions: A.
        config: how to learn.
        seed: of the critics' first parameters and of the noise.
        num_features: F. With them, critics learn successor features (Barreto et al. 2017), without what
            entropy is worth later, as in CSF (arXiv 2412.08021).
    """

    def __init__(
        self,
        actor: nn.Module,
        num_inputs: int,
        num_actions: int,
        config: SACConfig,
        seed: int,
        num_features: int | None = None,
    ) -> None:
        self.config, self.actor, self.num_actions = config, actor, num_actions
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.critics, self._targets = (
                Critics(num_inputs, num_actions, config.hidden_sizes, num_features, layer_norm=config.critic_layer_norm)
                for _ in range(2)
            )
        self._targets.load_state_dict(self.critics.state_dict())
        self._targets.requires_grad_(requires_grad=False)
        self._log_alpha = torch.tensor(math.log(config.initial_entropy_coefficient), requires_grad=True)
        self._parameters: dict[str, dict[str, Tensor]] = {
            "actor": dict(actor.named_parameters()),
            "critics": dict(self.critics.named_parameters()),
            "alpha": {"log": self._log_alpha},
        }
        self._optimizers = {
            name: Adam(parameters, config.learning_rate, epsilon=ADAM_EPSILON)
            for name, parameters in self._parameters.items()
        }
        self._random = torch.Generator().manual_seed(seed)
        self._average = {name: parameter.detach().clone() for name, parameter in actor.named_parameters()}
        self._num_averaged = torch.zeros((), dtype=torch.int64)

    def act(self, inputs: FloatArray) -> FloatArray:
        """Sample (N, A) actions in [-1, 1] at (N, I) inputs."""
        with torch.no_grad():
            mean, log_std = self.actor(torch.from_numpy(inputs))
            actions, _ = sample_actions(mean, log_std, self._noise(mean))
        sampled: FloatArray = actions.numpy()
        return sampled

    def update(self, batch: Batch) -> Metrics:
        """Learn from a batch in ``gradient_steps`` steps, each from its own ``batch_size`` rows.

        Returns:
            Means over the steps.
        """
        columns = [torch.from_numpy(rows).split(self.config.batch_size) for rows in batch if rows is not None]
        found = torch.stack([self._step(*part) for part in zip(*columns, strict=True)]).mean(0).tolist()
        names = "critic_loss", "actor_loss", "entropy_coefficient", "entropy"
        return dict(zip(names, found, strict=True))

    def average_actor(self) -> None:
        """Move the actor's average towards the actor; it spans about an eighth of all calls.

        Polynomial-decay averaging (Shamir and Zhang 2013): an actor's success changes from update to update much more
        than what it has learned.
        """
        keep = self._num_averaged / (8 + self._num_averaged)
        self._num_averaged += 1
        with torch.no_grad():
            for name, parameter in self._parameters["actor"].items():
                self._average[name].lerp_(parameter, 1.0 - keep)

    def averaged_parameters(self) -> dict[str, FloatArray]:
        """Parameters and buffers of the averaged actor, as float32 copies by name."""
        return export_parameters(self.actor) | {name: each.numpy().copy() for name, each in self._average.items()}

    def state(self) -> Arrays:
        """Everything that ``load_state`` continues from, copied."""
        return copied(self._tensors()) | {"random": self._random.get_state().numpy().copy()}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Continue, bit for bit, where ``state`` was taken by a learner of the same settings."""
        put_back(state, self._tensors())
        self._random.set_state(torch.from_numpy(np.array(state["random"])))

    def _tensors(self) -> dict[str, Tensor]:
        """All that changes but the random numbers, by name: the tensors themselves."""
        parts: dict[str, Mapping[str, Tensor]] = {**self._parameters}
        parts |= {f"adam/{name}": optimizer.tensors() for name, optimizer in self._optimizers.items()}
        parts |= {"targets": dict(self._targets.named_parameters()), "average": self._average}
        parts["count"] = {"averaged": self._num_averaged}
        return join_parts(parts)

    def _step(
        self, inputs: Tensor, actions: Tensor, rewards: Tensor, next_inputs: Tensor, weights: Tensor | None = None
    ) -> Tensor:
        alpha = self._log_alpha.detach().exp()
        with torch.no_grad():
            mean, log_std = self.actor(next_inputs)
            next_actions, next_log_prob = sample_actions(mean, log_std, self._noise(mean))
            following = self._targets(next_inputs, next_actions)
            if weights is None:
                following = following.amin(0) - alpha * next_log_prob
            else:  # the features of the critic that thinks less of them
                lower = (following * weights).sum(-1).argmin(0)
                following = following[lower, torch.arange(len(lower))]
            target = rewards + self.config.gamma * following
        errors = (self.critics(inputs, actions) - target).square()
        critic_loss = 0.5 * (errors.mean(1) if weights is None else errors.mean((1, 2))).sum()
        self._optimizers["critics"].descend(critic_loss)
        mean, log_std = self.actor(inputs)
        new_actions, log_prob = sample_actions(mean, log_std, self._noise(mean))
        values = self.critics(inputs, new_actions)
        values = values if weights is None else (values * weights).sum(-1)
        actor_loss = (alpha * log_prob - values.amin(0)).mean()
        self._optimizers["actor"].descend(actor_loss)
        entropy = -log_prob.detach().mean()
        if self.config.learn_entropy_coefficient:
            target_entropy = self.config.target_entropy * self.num_actions
            self._optimizers["alpha"].descend(self._log_alpha * (entropy - target_entropy))
        with torch.no_grad():
            for own, critic in zip(self._targets.parameters(), self.critics.parameters(), strict=True):
                own.lerp_(critic, self.config.tau)
        return torch.stack((critic_loss.detach(), actor_loss.detach(), alpha, entropy))

    def _noise(self, like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=self._random)
