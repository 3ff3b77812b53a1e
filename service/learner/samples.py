"""The data a player learns from: B samples of turns, D steps of demonstrations."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
import torch
from torch import Tensor

from service.actors.rollout import Demonstrations, join_demonstrations
from service.base.types import Array, Arrays, IntArray
from service.config.self_play import CloningConfig, PPOConfig
from service.envs.observations import ACTION, Layouts, Mirror
from service.learner.player import Player
from service.policies import gaussian


class _Rows:
    """A dataclass of tensors with equally many rows."""

    def __len__(self) -> int:
        return len(self.columns()[0])

    def columns(self) -> list[Tensor]:
        """The tensors, in the order of the fields."""
        return [getattr(self, field.name) for field in fields(self)]  # type: ignore[arg-type]

    def take(self, places: IntArray) -> Self:
        """Take the rows at these places, in their order."""
        rows = torch.from_numpy(places).to(self.columns()[0].device)
        return type(self)(*(column.index_select(0, rows) for column in self.columns()))


@dataclass(frozen=True, slots=True)
class Samples(_Rows):
    """Steps of one player's own turns; ``ppo`` says which policies are meant."""

    observation: Tensor
    """(B, O)."""
    value_observation: Tensor
    """(B, V)."""
    action: Tensor
    """(B, A)."""
    behaviour_log_prob: Tensor
    """(B,) of the action under the policy that acted."""
    proximal_mean: Tensor
    """(B, A) of the policy at the start of the update."""
    proximal_std: Tensor
    """(B, A)."""
    advantage: Tensor
    """(B,) normalised."""
    value_target: Tensor
    """(B,) advantage, not normalised, plus ``value``."""
    value: Tensor
    """(B,) estimated at the start of the update."""

    @property
    def proximal_log_prob(self) -> Tensor:
        """(B,) of the action under the policy at the start of the update."""
        return gaussian.log_prob(self.action, self.proximal_mean, self.proximal_std)


@dataclass(frozen=True, slots=True)
class Cloning(_Rows):
    """Demonstrations ready to be cloned."""

    observation: Tensor
    """(D, O)."""
    action: Tensor
    """(D, A)."""
    proximal_log_prob: Tensor
    """(D,) of the action under the policy at the start of the update."""


@dataclass(frozen=True, slots=True)
class DemonstrationRows:
    """Demonstrations that minibatches are drawn from, far more than an update draws."""

    observation: Tensor
    """(D, O)."""
    action: Tensor
    """(D, A)."""
    mirror: Mirror | None = None
    """Of observations; where there is one, as many reflections in y follow, which are made when they are taken."""

    def __len__(self) -> int:
        return len(self.action) * (1 if self.mirror is None else 2)

    def take(self, places: IntArray) -> DemonstrationRows:
        """Take the rows at these places, in their order."""
        num, device = len(self.action), self.action.device
        rows = torch.from_numpy(places % num).to(device)
        observation, action = (column.index_select(0, rows) for column in (self.observation, self.action))
        if self.mirror is not None:
            reflected = torch.from_numpy(places >= num).to(device)[:, None]
            observation = torch.where(reflected, _reflect(observation, self.mirror), observation)
            action = torch.where(reflected, _reflect(action, ACTION.mirror), action)
        return DemonstrationRows(observation, action)

    def to_clone(self, places: IntArray, player: Player) -> Cloning:
        """Prepare the rows at these places; ``player`` is at the start of the update."""
        part = self.take(places)
        with torch.no_grad():
            log_prob = player.log_prob(part.observation, part.action)
        return Cloning(part.observation, part.action, log_prob)


class DemonstrationHistory:
    """Demonstrations of the last ``num_iterations`` iterations; one without demonstrations counts too."""

    def __init__(self, num_iterations: int, observation_size: int) -> None:
        """Start empty."""
        self._iterations: deque[Demonstrations] = deque(maxlen=num_iterations)
        numbers = np.zeros((0, observation_size), dtype=np.float32), np.zeros((0, ACTION.size), dtype=np.float32)
        self._nothing = Demonstrations(*numbers)

    def append(self, demonstrations: Iterable[Demonstrations]) -> None:
        """Add one iteration, without steps that are not finite; the oldest one goes if there are too many."""
        new = self._join(demonstrations)
        finite = np.isfinite(new.observation).all(1) & np.isfinite(new.action).all(1)
        self._iterations.append(Demonstrations(new.observation[finite], new.action[finite]))

    def joined(self) -> Demonstrations:
        """Join all that is kept, oldest first."""
        return self._join(self._iterations)

    def state(self) -> Arrays:
        """Everything that a resumed run needs, by name."""
        everything = self.joined()
        num_steps = np.array([len(each.action) for each in self._iterations], dtype=np.int64)
        return {"observation": everything.observation, "action": everything.action, "num_steps": num_steps}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Continue where ``state`` was taken; a shorter history keeps the newest."""
        self._iterations.clear()
        ends = np.cumsum(state["num_steps"])
        for start, end in zip(ends - state["num_steps"], ends, strict=True):
            rows = slice(int(start), int(end))
            self._iterations.append(Demonstrations(state["observation"][rows].copy(), state["action"][rows].copy()))

    def _join(self, parts: Iterable[Demonstrations]) -> Demonstrations:
        return join_demonstrations([self._nothing, *parts])


def reflect_at_random(samples: Samples, seen: Layouts, bob: Player, rng: np.random.Generator) -> Samples:
    """Replace half of Bob's samples, chosen at random, by their reflections in y."""
    places = np.flatnonzero(rng.random(len(samples)) < 0.5)
    reflections = _reflections(samples.take(places), seen, bob)
    rows = torch.from_numpy(places).to(samples.observation.device)
    pairs = zip(samples.columns(), reflections.columns(), strict=True)
    return Samples(*(column.index_copy(0, rows, reflected) for column, reflected in pairs))


def draw_epoch(
    num_samples: int, num_demonstrations: int, config: PPOConfig, how: CloningConfig, rng: np.random.Generator
) -> list[tuple[IntArray, IntArray]]:
    """Draw the minibatches of an epoch: each sample once, in random order, beside demonstrations drawn alike.

    Samples are cut into as many equal minibatches as bring them nearest to the configured size. Each has
    ``how.rows_per_sample`` times as many demonstrations, which are cycled through if they are too few. Demonstrations
    alone are gone through once.

    Args:
        num_samples: may be 0 where there are demonstrations.
        num_demonstrations: may be 0 where there are samples.
        config: size of a minibatch of samples.
        how: demonstrations beside them.
        rng: shuffles.

    Returns:
        Places of each minibatch's samples and of its demonstrations.
    """
    num_cloned = max(int(config.minibatch_size * how.rows_per_sample), 1)
    if num_samples:
        num = max(round(num_samples / config.minibatch_size), 1)
    else:
        num = max(round(num_demonstrations / num_cloned), 1)
    samples = _draw(num_samples, num_samples, rng)
    demonstrations = _draw(num_demonstrations, num * min(num_cloned, num_demonstrations), rng)
    return list(zip(np.array_split(samples, num), np.array_split(demonstrations, num), strict=True))


def _draw(num_rows: int, num: int, rng: np.random.Generator) -> IntArray:
    """Draw ``num`` places of rows in random order, none twice before each was drawn once."""
    rounds = [rng.permutation(num_rows) for _ in range(-(-num // num_rows))] if num_rows else []
    return np.concatenate([np.zeros(0, dtype=np.int64), *rounds])[:num]


def _reflections(samples: Samples, seen: Layouts, bob: Player) -> Samples:
    """Reflect Bob's samples.

    A reflection was acted by the reflected behaviour policy, so it has the behaviour log-probability of its original.
    The importance weight, or without ``decoupled`` PPO's ratio, then says how much it counts: little, where he
    would hardly act like that. With a full weight one reflection in ten, tens of standard deviations from the mean,
    ruled the gradient.
    """
    observations = _reflect(samples.observation, seen.bob.mirror)
    with torch.no_grad():
        mean, std = bob.policy(observations)
    return replace(
        samples,
        observation=observations,
        value_observation=_reflect(samples.value_observation, seen.bob_value.mirror),
        action=_reflect(samples.action, ACTION.mirror),
        proximal_mean=mean,
        proximal_std=std,
    )


def _reflect(rows: Tensor, mirror: Mirror) -> Tensor:
    """Reflect (B, size) rows."""
    source = torch.from_numpy(mirror.source).to(rows.device)
    return rows.index_select(1, source) * torch.from_numpy(mirror.sign).to(rows.device)
