"""What a player learns from, as flat tensors: B samples of turns, D steps of demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from service.actors.rollout import Turns
from service.config import PPOConfig
from service.envs.observations import Mirror
from service.learner.returns import advantages
from service.policies import gaussian

Estimate = Callable[[Tensor], Tensor]
Policy = Callable[[Tensor], tuple[Tensor, Tensor]]


class _Rows:
    """A dataclass of tensors with equally many rows."""

    def __len__(self) -> int:
        return len(self.tensors()[0])

    def take(self, rows: Tensor) -> Self:
        """The rows of these indices, in their order."""
        return type(self)(*(tensor.index_select(0, rows) for tensor in self.tensors()))

    def split(self, num_parts: int) -> list[Self]:
        """Consecutive parts, as views; sizes differ by one at most."""
        parts = [tensor.tensor_split(num_parts) for tensor in self.tensors()]
        return [type(self)(*columns) for columns in zip(*parts, strict=True)]

    def tensors(self) -> list[Tensor]:
        """The columns, in the order of the fields."""
        return [getattr(self, field.name) for field in fields(self)]  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Samples(_Rows):
    """Steps of one player's own turns."""

    observation: Tensor
    """(B, O)."""
    value_observation: Tensor
    """(B, V)."""
    action: Tensor
    """(B, A)."""
    old_log_prob: Tensor
    """(B,) under the policy that acted."""
    start_mean: Tensor
    """(B, A) of the policy at the start of the update, which may be a version or two ahead of the one that acted."""
    start_std: Tensor
    """(B, A)."""
    advantage: Tensor
    """(B,) normalised."""
    target: Tensor
    """(B,) of the value network: advantage, not normalised, plus ``value``."""
    value: Tensor
    """(B,) estimated at the start of the update."""

    @property
    def start_log_prob(self) -> Tensor:
        """(B,) under the policy at the start of the update."""
        return gaussian.log_prob(self.action, self.start_mean, self.start_std)


@dataclass(frozen=True, slots=True)
class Cloning(_Rows):
    """Demonstrations ready to be cloned."""

    observation: Tensor
    """(D, O)."""
    action: Tensor
    """(D, A)."""
    old_log_prob: Tensor
    """(D,) under the policy at the start of the update."""


def collect(
    turns: Sequence[Turns], estimate: Estimate, policy: Policy, config: PPOConfig, device: torch.device
) -> Samples | None:
    """Turn what was played into samples; only active steps of worlds that ``learn`` count.

    Args:
        turns: of one player, with equal T; joined along worlds.
        estimate: value network, (B, V) to (B,).
        policy: mean and std at (B, O) observations, at the start of the update.
        config: discount and lambda.
        device: where the tensors shall be.

    Returns:
        The samples, None if there are none.
    """
    active = _join(turns, "active")
    num_samples = int(active.sum())
    if num_samples == 0:
        return None
    names = {name: name for name in ("observation", "value_observation", "action")} | {"old_log_prob": "log_prob"}
    tensors = {key: torch.from_numpy(_join(turns, name)[active]).to(device) for key, name in names.items()}
    final = torch.from_numpy(np.concatenate([part.final_value_observation[part.learn] for part in turns])).to(device)
    with torch.no_grad():
        estimates = estimate(torch.cat((tensors["value_observation"], final)))
        tensors["start_mean"], tensors["start_std"] = policy(tensors["observation"])
    value = estimates[:num_samples]
    values = np.zeros(active.shape, dtype=np.float32)
    values[active] = value.cpu().numpy()
    final_values = estimates[num_samples:].cpu().numpy()
    rewards, terminated = _join(turns, "reward"), _join(turns, "terminated")
    discounts = {"gamma": config.gamma, "gae_lambda": config.gae_lambda}
    advantage = advantages(rewards, values, final_values, active, terminated, **discounts)[active]
    target = torch.from_numpy(advantage + values[active]).to(device)
    normalised = torch.from_numpy(_normalise(advantage)).to(device)
    return Samples(**tensors, advantage=normalised, target=target, value=value)


def mirrored(samples: Samples, policy: Policy, own: Mirror, value: Mirror, action: Mirror) -> Samples:
    """The samples followed by their reflections.

    A reflection was never acted, so its old log-probability is that of the policy at the start of the update.

    Args:
        samples: B of them.
        policy: mean and std at (B, O) observations, at the start of the update.
        own: reflects observations.
        value: reflects value observations.
        action: reflects actions.

    Returns:
        2B samples; advantage and target are the original's.
    """
    observation, actions = reflect(samples.observation, own), reflect(samples.action, action)
    with torch.no_grad():
        start = policy(observation)
        old_log_prob = gaussian.log_prob(actions, *start)
    value_observation = reflect(samples.value_observation, value)
    unchanged = samples.advantage, samples.target, samples.value
    reflections = Samples(observation, value_observation, actions, old_log_prob, *start, *unchanged)
    pairs = zip(samples.tensors(), reflections.tensors(), strict=True)
    return Samples(*(torch.cat(pair) for pair in pairs))


def reflect(rows: Tensor, mirror: Mirror) -> Tensor:
    """Reflect (B, size) rows in y."""
    source = torch.from_numpy(mirror.source).to(rows.device)
    return rows.index_select(1, source) * torch.from_numpy(mirror.sign).to(rows.device)


def _join(turns: Sequence[Turns], name: str) -> NDArray[Any]:
    """A (T, N, ...) field of all turns, learnable worlds only."""
    joined: NDArray[Any] = np.concatenate([getattr(part, name)[:, part.learn] for part in turns], axis=1)
    return joined


def _normalise(advantage: NDArray[np.float32]) -> NDArray[np.float32]:
    """To mean 0 and standard deviation 1; all zero if they do not differ."""
    wide = advantage.astype(np.float64)
    normalised: NDArray[np.float32] = ((wide - wide.mean()) / (wide.std() + 1e-8)).astype(np.float32)
    return normalised
