"""Soft actor-critic: an actor, two critics and an entropy coefficient, learned from batches of transitions.

Haarnoja et al. 2018 (arXiv 1812.05905), with the target entropy -A. No episode ends but by time, so every target looks
beyond its transition. The actor that is evaluated and exported is an average of those of the last iterations, as Bob's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim import Adam
from torch.optim.swa_utils import get_ema_multi_avg_fn

from service.policies.networks import export_parameters
from service.sac.networks import Critics, sample_actions
from service.sac.settings import SACConfig
from service.types import FloatArray, Metrics


class Batch(NamedTuple):
    """B transitions."""

    inputs: FloatArray
    """(B, I)"""
    actions: FloatArray
    """(B, A) in [-1, 1]."""
    rewards: FloatArray
    """(B,)"""
    next_inputs: FloatArray
    """(B, I)"""


class SACLearner:
    """Learns an actor; the same batches give the same actor, whatever else draws random numbers.

    Args:
        actor: gives mean and log-std before the tanh (``networks.Actor``).
        num_inputs: I.
        num_actions: A.
        config: how to learn.
        seed: of the critics' first parameters and of the noise.
    """

    def __init__(self, actor: nn.Module, num_inputs: int, num_actions: int, config: SACConfig, seed: int) -> None:
        self.config, self.actor, self.num_actions = config, actor, num_actions
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.critics, self._targets = (Critics(num_inputs, num_actions, config.hidden_sizes) for _ in range(2))
        self._targets.load_state_dict(self.critics.state_dict())
        self._targets.requires_grad_(requires_grad=False)
        self._log_alpha = torch.tensor(math.log(config.initial_entropy_coefficient), requires_grad=True)
        self._parameters: dict[str, list[Tensor]] = {
            "actor": list(actor.parameters()),
            "critics": list(self.critics.parameters()),
            "alpha": [self._log_alpha],
        }
        self._optimizers = {
            name: Adam(parameters, lr=config.learning_rate, fused=True) for name, parameters in self._parameters.items()
        }
        self._random = torch.Generator().manual_seed(seed)
        self._average = [parameter.detach().clone() for parameter in actor.parameters()]
        self._num_averaged = 0
        self._follow = get_ema_multi_avg_fn(1.0 - config.tau)

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
        columns = [torch.from_numpy(rows).split(self.config.batch_size) for rows in batch]
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
            for average, parameter in zip(self._average, self.actor.parameters(), strict=True):
                average.lerp_(parameter, 1.0 - keep)

    def averaged_parameters(self) -> dict[str, FloatArray]:
        """Parameters and buffers of the averaged actor, as float32 copies by name."""
        exported = export_parameters(self.actor)
        for (name, _), average in zip(self.actor.named_parameters(), self._average, strict=True):
            exported[name] = average.numpy().copy()
        return exported

    def state(self) -> dict[str, Any]:
        """Everything that ``load_state`` continues from, as tensors and plain values."""
        return {
            "parameters": {name: [each.detach().clone() for each in part] for name, part in self._parameters.items()},
            "targets": [each.clone() for each in self._targets.parameters()],
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self._optimizers.items()},
            "average": [each.clone() for each in self._average],
            "num_averaged": self._num_averaged,
            "random": self._random.get_state(),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Continue, bit for bit, where ``state`` was taken by a learner of the same settings."""
        pairs = [(self._parameters[name], saved) for name, saved in state["parameters"].items()]
        pairs += [(list(self._targets.parameters()), state["targets"]), (self._average, state["average"])]
        with torch.no_grad():
            for tensors, saved in pairs:
                for tensor, value in zip(tensors, saved, strict=True):
                    tensor.copy_(value)
        for name, optimizer in self._optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self._num_averaged = state["num_averaged"]
        self._random.set_state(state["random"])

    def _step(self, inputs: Tensor, actions: Tensor, rewards: Tensor, next_inputs: Tensor) -> Tensor:
        alpha = self._log_alpha.detach().exp()
        with torch.no_grad():
            mean, log_std = self.actor(next_inputs)
            next_actions, next_log_prob = sample_actions(mean, log_std, self._noise(mean))
            following = self._targets(next_inputs, next_actions).amin(0) - alpha * next_log_prob
            target = rewards + self.config.gamma * following
        critic_loss = 0.5 * (self.critics(inputs, actions) - target).square().mean(1).sum()
        self._descend("critics", critic_loss)
        mean, log_std = self.actor(inputs)
        new_actions, log_prob = sample_actions(mean, log_std, self._noise(mean))
        actor_loss = (alpha * log_prob - self.critics(inputs, new_actions).amin(0)).mean()
        self._descend("actor", actor_loss)
        entropy = -log_prob.detach().mean()
        self._descend("alpha", self._log_alpha * (entropy + self.num_actions))
        self._follow(list(self._targets.parameters()), self._parameters["critics"], 0)
        return torch.stack((critic_loss.detach(), actor_loss.detach(), alpha, entropy))

    def _descend(self, name: str, loss: Tensor) -> None:
        """Take a gradient step with these parameters alone: others, through which the loss goes, get no gradient."""
        parameters = self._parameters[name]
        for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            parameter.grad = gradient
        self._optimizers[name].step()

    def _noise(self, like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=self._random)


def actions_at_random(shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
    """Uniform actions in [-1, 1], float32: what a new learner begins with."""
    return rng.uniform(-1.0, 1.0, shape).astype(np.float32)
