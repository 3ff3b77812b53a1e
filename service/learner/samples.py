"""The data a player learns from: B samples of turns, D steps of demonstrations."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from service.actors.rollout import Demonstrations
from service.config import CloningConfig, PPOConfig
from service.envs.observations import ACTION, Layouts, Mirror
from service.learner.player import Player
from service.learner.shares import Share
from service.policies import gaussian
from service.types import Array, Arrays, IntArray

Rows = TypeVar("Rows", bound="_Rows")


class _Rows:
    """A dataclass of tensors with equally many rows, and of ``share``: their places among the rows of all ranks."""

    share: Share | None

    def __len__(self) -> int:
        return len(self.tensors()[0])

    @property
    def num_total(self) -> int:
        """Rows of all ranks together."""
        return len(self) if self.share is None else self.share.total

    def take(self, rows: Tensor) -> Self:
        """Take the rows of these indices, in their order."""
        return type(self)(*(tensor.index_select(0, rows) for tensor in self.tensors()))

    def tensors(self) -> list[Tensor]:
        """The columns, in the order of the fields."""
        return [getattr(self, name) for name in self.names()]

    def names(self) -> list[str]:
        """Names of the columns, in the order of the fields."""
        return [field.name for field in fields(self) if field.name not in ("share", "mirror")]  # type: ignore[arg-type]

    def having(self, columns: Iterable[Tensor], share: Share | None) -> Self:
        """The same rows with other columns, in the order of the fields."""
        return replace(self, **dict(zip(self.names(), columns, strict=True)), share=share)  # type: ignore[type-var]

    def find(self, drawn: IntArray) -> Self:
        """Take the own ones of the rows at these places of all ranks' rows, in their order."""
        if self.share is None:
            rows, share = drawn, None
        else:
            rows, share = self.share.find(drawn)
        return replace(self.take(torch.from_numpy(rows).to(self.tensors()[0].device)), share=share)  # type: ignore[type-var]


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
    share: Share | None = None
    """Places among the samples of all ranks; None without other ranks."""

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
    share: Share | None = None
    """Places among all that could be drawn, of all ranks; None where these are all."""


@dataclass(frozen=True, slots=True)
class DemonstrationRows(_Rows):
    """Demonstrations that minibatches are drawn from, far more than an update draws."""

    observation: Tensor
    """(D, O)."""
    action: Tensor
    """(D, A)."""
    mirror: Mirror | None = None
    """Of observations; where there is one, as many reflections in y follow, which are made when they are drawn."""
    share: Share | None = None
    """Places among the demonstrations of all ranks; None without other ranks."""

    @property
    def num_total(self) -> int:
        """Rows of all ranks together, with their reflections."""
        return (len(self) if self.share is None else self.share.total) * self._num_copies

    @property
    def _num_copies(self) -> int:
        return 1 if self.mirror is None else 2

    def find(self, drawn: IntArray) -> DemonstrationRows:
        """Take the own ones of the rows at these places of all ranks' rows, in their order; reflections are made."""
        num = self.num_total // self._num_copies
        part = _Rows.find(self, drawn % num)
        if self.mirror is None:
            return part
        own = drawn if part.share is None else drawn[part.share.places]
        reflected = torch.from_numpy(own >= num).to(self.observation.device)[:, None]
        pairs = zip(part.tensors(), (self.mirror, ACTION.mirror), strict=True)
        columns = (torch.where(reflected, _reflect(column, mirror), column) for column, mirror in pairs)
        return part.having(columns, part.share)

    def to_clone(self, drawn: IntArray, player: Player) -> Cloning:
        """Prepare the own ones of the rows at these places, ascending; ``player`` is at the start of the update."""
        part = self.find(drawn)
        places = drawn if part.share is None else drawn[part.share.places]
        with torch.no_grad():
            log_prob = player.log_prob(part.observation, part.action)
        return Cloning(part.observation, part.action, log_prob, Share(places, self.num_total))


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

    def sizes(self) -> IntArray:
        """Steps of each iteration, oldest first."""
        return np.array([len(each.action) for each in self._iterations], dtype=np.int64)

    def state(self) -> Arrays:
        """Everything that a resumed run needs, by name."""
        everything = self.joined()
        return {"observation": everything.observation, "action": everything.action, "num_steps": self.sizes()}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Continue where ``state`` was taken; a shorter history keeps the newest."""
        self._iterations.clear()
        ends = np.cumsum(state["num_steps"])
        for start, end in zip(ends - state["num_steps"], ends, strict=True):
            rows = slice(int(start), int(end))
            self._iterations.append(Demonstrations(state["observation"][rows].copy(), state["action"][rows].copy()))

    def _join(self, parts: Iterable[Demonstrations]) -> Demonstrations:
        all_parts = [self._nothing, *parts]
        observation = np.concatenate([part.observation for part in all_parts])
        return Demonstrations(observation, np.concatenate([part.action for part in all_parts]))


@dataclass(frozen=True, slots=True)
class Mirrors:
    """Reflections in y of what a player sees."""

    observation: Mirror
    value_observation: Mirror


def alices(layouts: Layouts) -> Mirrors:
    """Reflections of what Alice sees."""
    return Mirrors(layouts.full.mirror, layouts.full.mirror)


def bobs(layouts: Layouts) -> Mirrors:
    """Reflections of what Bob sees."""
    return Mirrors(layouts.bob.mirror, layouts.bob_value.mirror)


def mirror(samples: Samples, mirrors: Mirrors, player: Player, rng: np.random.Generator) -> Samples:
    """Augment samples by symmetry, as ``PPOConfig.mirror`` of the player says."""
    if player.config.mirror == "both":
        return augment_by_symmetry(samples, mirrors, player)
    return reflect_at_random(samples, mirrors, player, rng) if player.config.mirror == "random" else samples


def augment_by_symmetry(samples: Samples, mirrors: Mirrors, player: Player) -> Samples:
    """Append the reflections in y of samples, which have the originals' advantages and values."""
    reflections = _reflections(samples, mirrors, player)
    pairs = zip(samples.tensors(), reflections.tensors(), strict=True)
    return samples.having(map(torch.cat, pairs), samples.share and samples.share.mirrored())


def reflect_at_random(samples: Samples, mirrors: Mirrors, player: Player, rng: np.random.Generator) -> Samples:
    """Replace half of the samples, chosen at random, by their reflections in y: half the work of learning both."""
    chosen = rng.random(samples.num_total) < 0.5  # of all ranks, so that all draw alike
    own = chosen if samples.share is None else chosen[samples.share.places]
    rows = torch.from_numpy(np.flatnonzero(own)).to(samples.observation.device)
    reflections = _reflections(samples.take(rows), mirrors, player)
    pairs = zip(samples.tensors(), reflections.tensors(), strict=True)
    return samples.having((column.index_copy(0, rows, reflected) for column, reflected in pairs), samples.share)


def draw_epoch(
    num_samples: int, num_demonstrations: int, config: PPOConfig, how: CloningConfig, rng: np.random.Generator
) -> list[tuple[IntArray, IntArray]]:
    """Draw the minibatches of an epoch: each sample once, in random order, beside demonstrations drawn alike.

    Samples are cut into as many equal minibatches as bring them nearest to the configured size. Each has
    ``how.rows_per_sample`` times as many demonstrations, which are cycled through if they are too few. Demonstrations
    alone are gone through once.

    The rows of all ranks are drawn together, so with equal random numbers all draw the same.

    Args:
        num_samples: of all ranks; may be 0 where there are demonstrations.
        num_demonstrations: of all ranks; may be 0 where there are samples.
        config: size of a minibatch of samples, of all ranks together.
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


def _reflections(samples: Samples, mirrors: Mirrors, player: Player) -> Samples:
    """Reflect samples in y.

    A reflection was acted by the reflected behaviour policy, so it has the behaviour log-probability of its original.
    The importance weight, or without ``decoupled`` PPO's ratio, then says how much it counts: little, where ``player``
    would hardly act like that. With a full weight one reflection in ten, tens of standard deviations from the mean,
    ruled the gradient.
    """
    observations = _reflect(samples.observation, mirrors.observation)
    actions = _reflect(samples.action, ACTION.mirror)
    with torch.no_grad():
        mean, std = player.policy(observations)
    return replace(
        samples,
        observation=observations,
        value_observation=_reflect(samples.value_observation, mirrors.value_observation),
        action=actions,
        proximal_mean=mean,
        proximal_std=std,
    )


def _reflect(rows: Tensor, mirror: Mirror) -> Tensor:
    """Reflect (B, size) rows in y."""
    source = torch.from_numpy(mirror.source).to(rows.device)
    return rows.index_select(1, source) * torch.from_numpy(mirror.sign).to(rows.device)
