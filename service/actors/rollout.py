"""Rollouts: one round of self-play on N worlds, as plain arrays; and the weights that it is played with.

Shapes: T steps of a turn (time first), N worlds, D demonstration steps. Network inputs and outputs are float32, physics
states float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from service.base.types import Arrays, BoolArray, FloatArray, Metrics, StateArray
from service.generator.records import GoalRecords

Diverged = tuple[tuple[StateArray, FloatArray], ...]
"""(last finite state (S,), action (4,)) of each world whose physics diverged."""
MAX_POLICY_LAG = 2
"""Policy versions between the one that acted and the one that learns from it, at most; 1 where all are equally fast."""


@dataclass(frozen=True, slots=True)
class Weights:
    """Parameters of both players, of one policy version."""

    version: int
    alice: dict[str, FloatArray]
    bob: dict[str, FloatArray]
    bob_ema: dict[str, FloatArray]
    """Moving average of Bob's parameters, to be evaluated and published; see ``learner.bob_ema_decay``."""


@dataclass(frozen=True, slots=True)
class Turns:
    """One player's turns in a round.

    A step counts only where ``active``; the rest is zero. A turn that ends without ``terminated`` ran out of time, and
    its return is bootstrapped from ``final_value_observation``.
    """

    observation: FloatArray
    """(T, N, O) policy input."""
    value_observation: FloatArray
    """(T, N, V) value-network input."""
    final_value_observation: FloatArray
    """(N, V) value-network input after each world's last active step."""
    action: FloatArray
    """(T, N, A) as sampled, before the world clips it to [-1, 1]."""
    log_prob: FloatArray
    """(T, N) of ``action`` under the acting policy."""
    reward: FloatArray
    """(T, N)."""
    active: BoolArray
    """(T, N) the step was played; true up to the turn's last step."""
    terminated: BoolArray
    """(T, N) the turn truly ended with this step: no bootstrap."""
    learn: BoolArray
    """(N,) played by the current policy version; not a past opponent's, a diverged world's, or of an untried goal."""


@dataclass(frozen=True, slots=True)
class Demonstrations:
    """Steps that a player clones: Alice's and Bob's own, relabelled for Bob, or Alice's own for herself."""

    observation: FloatArray
    """(D, O) input of the player that clones; Bob's has the goal that was reached."""
    action: FloatArray
    """(D, A)."""


def join_demonstrations(parts: Sequence[Demonstrations]) -> Demonstrations:
    """All steps of several parts, in their order."""
    observation = np.concatenate([part.observation for part in parts])
    return Demonstrations(observation, np.concatenate([part.action for part in parts]))


@dataclass(frozen=True, slots=True)
class Rollout:
    """One round on a batch of worlds, as the learner and the task generator need it."""

    actor: int
    incarnation: int
    sequence: int
    policy_version: int
    alice: Turns
    bob: Turns
    demonstrations: Demonstrations
    records: GoalRecords
    num_env_steps: int
    """Both players' steps, only those simulated."""
    metrics: Metrics
    """Counters of this round, e.g. ``alice/contact_fraction``."""

    diverged: Diverged = ()
    """Not part of a checkpoint."""

    @property
    def id(self) -> tuple[int, int, int]:
        """(actor, incarnation, sequence), unique within a run; the learner counts a rollout once by it."""
        return self.actor, self.incarnation, self.sequence


def to_arrays(rollout: Rollout) -> Arrays:
    """Flat named arrays, for a checkpoint; ``from_arrays`` gives an equal rollout back."""
    arrays = {
        f"{part}/{field.name}": getattr(getattr(rollout, part), field.name)
        for part, kind in _PARTS.items()
        for field in fields(kind)
    }
    numbers = {name: np.array(getattr(rollout, name)) for name in _NUMBERS}
    return arrays | numbers | {f"metrics/{name}": np.array(value) for name, value in rollout.metrics.items()}


def from_arrays(arrays: Arrays) -> Rollout:
    """The rollout that ``to_arrays`` flattened."""
    values: dict[str, Any] = {
        part: kind(**{field.name: arrays[f"{part}/{field.name}"] for field in fields(kind)})
        for part, kind in _PARTS.items()
    }
    metrics = {k.removeprefix("metrics/"): float(v) for k, v in arrays.items() if k.startswith("metrics/")}
    values |= {name: int(arrays[name]) for name in _NUMBERS}
    return Rollout(**values, metrics=metrics)


_PARTS: dict[str, type] = {"alice": Turns, "bob": Turns, "demonstrations": Demonstrations, "records": GoalRecords}
_NUMBERS = ("actor", "incarnation", "sequence", "policy_version", "num_env_steps")
