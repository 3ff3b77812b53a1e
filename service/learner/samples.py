"""The data a player learns from: B samples of turns, D steps of demonstrations."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from service.actors.rollout import Demonstrations
from service.envs.observations import ACTION, BOB, BOB_VALUE, Mirror
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

    def split(self, num_parts: int) -> list[Self]:
        """Cut into consecutive parts, as views; sizes differ by one at most."""
        parts = [tensor.tensor_split(num_parts) for tensor in self.tensors()]
        return [type(self)(*columns) for columns in zip(*parts, strict=True)]

    def tensors(self) -> list[Tensor]:
        """The columns, in the order of the fields."""
        return [getattr(self, field.name) for field in fields(self) if field.name != "share"]  # type: ignore[arg-type]

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
    """Places among the demonstrations of all ranks; None without other ranks."""


class DemonstrationHistory:
    """Demonstrations of the last ``num_iterations`` iterations; one without demonstrations counts too."""

    def __init__(self, num_iterations: int) -> None:
        """Start empty."""
        self._iterations: deque[Demonstrations] = deque(maxlen=num_iterations)

    def append(self, demonstrations: Iterable[Demonstrations]) -> None:
        """Add one iteration, without steps that are not finite; the oldest one goes if there are too many."""
        new = _join(demonstrations)
        finite = np.isfinite(new.observation).all(1) & np.isfinite(new.action).all(1)
        self._iterations.append(Demonstrations(new.observation[finite], new.action[finite]))

    def joined(self) -> Demonstrations:
        """Join all that is kept, oldest first."""
        return _join(self._iterations)

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


def augment_by_symmetry(samples: Samples, player: Player) -> Samples:
    """Append the reflections in y of Bob's samples, which have the originals' advantages and values.

    Nobody acted a reflection, so its behaviour log-probability is that of the policy at the start of the update, which
    is ``player``'s.
    """
    observations, actions = _reflect(samples.observation, BOB.mirror), _reflect(samples.action, ACTION.mirror)
    with torch.no_grad():
        mean, std = player.policy(observations)
    reflections = replace(
        samples,
        observation=observations,
        value_observation=_reflect(samples.value_observation, BOB_VALUE.mirror),
        action=actions,
        behaviour_log_prob=gaussian.log_prob(actions, mean, std),
        proximal_mean=mean,
        proximal_std=std,
    )
    pairs = zip(samples.tensors(), reflections.tensors(), strict=True)
    columns: list[Any] = [torch.cat(pair) for pair in pairs]
    return replace(Samples(*columns), share=None if samples.share is None else samples.share.mirrored())


def minibatches(
    samples: Samples | None, cloning: Cloning | None, size: int, rng: np.random.Generator
) -> list[tuple[Samples | None, Cloning | None]]:
    """Cut an epoch: each sample once, in random order, beside demonstrations drawn from a shuffled permutation.

    Samples are cut into as many equal minibatches as bring them nearest to ``size``. Demonstrations come in half that
    size, and are cycled through if they are too few. Demonstrations alone are gone through once.

    The rows of all ranks are cut together: with equal random numbers the minibatches of every rank are its own rows of
    the same minibatches, maybe none.

    Args:
        samples: B of them, or None.
        cloning: D demonstrations, or None; not both None.
        size: of a minibatch of samples, of all ranks together.
        rng: shuffles.
    """
    half = max(size // 2, 1)
    if samples is not None:
        num = max(round(samples.num_total / size), 1)
    else:
        assert cloning is not None, "an epoch needs samples or demonstrations"
        num = max(round(cloning.num_total / half), 1)
    own = [None] * num if samples is None else _draw(samples, samples.num_total, num, rng)
    drawn = [None] * num if cloning is None else _draw(cloning, num * min(half, cloning.num_total), num, rng)
    return list(zip(own, drawn, strict=True))


def _join(parts: Iterable[Demonstrations]) -> Demonstrations:
    observations = [np.zeros((0, BOB.size), dtype=np.float32), *(part.observation for part in parts)]
    actions = [np.zeros((0, ACTION.size), dtype=np.float32), *(part.action for part in parts)]
    return Demonstrations(np.concatenate(observations), np.concatenate(actions))


def _draw(rows: Rows, num: int, num_parts: int, rng: np.random.Generator) -> list[Rows]:
    """Draw ``num`` rows of all ranks in random order, none twice before each was drawn once; the own ones in parts."""
    rounds = [rng.permutation(rows.num_total) for _ in range(-(-num // rows.num_total))]
    drawn = np.concatenate(rounds)[:num]
    if rows.share is None:
        return rows.find(drawn).split(num_parts)  # copied once
    return [rows.find(part) for part in np.array_split(drawn, num_parts)]


def _reflect(rows: Tensor, mirror: Mirror) -> Tensor:
    """Reflect (B, size) rows in y."""
    source = torch.from_numpy(mirror.source).to(rows.device)
    return rows.index_select(1, source) * torch.from_numpy(mirror.sign).to(rows.device)
