"""Number of rollout actors that a run can use, from the costs of its parts: arithmetic only, nothing is measured here.

An update takes one rollout of each of N actors, and all parts work side by side: while actors play, the learner
learns from the rollouts before. So the slowest part sets the pace, and what it costs is

    seconds per update = update_s + N (rollout_s + W world_s) + N^2 pair_s

with W worlds for each actor. Actors work at the same time and pay for their own rollout only. As long as they are
the slowest, N actors are N times as fast as one; the first part that takes longer than they do is the first
bottleneck, and from there on more actors help no more.

Every actor is counted as a core, and the learner as one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

ACTORS = "actors"
MAX_ACTORS = 1 << 24


@dataclass(frozen=True, slots=True)
class Cost:
    """Seconds that one part is busy for an update."""

    update_s: float = 0.0
    rollout_s: float = 0.0
    """Seconds for each rollout, whatever its size."""
    world_s: float = 0.0
    """Seconds for each world of each rollout."""
    pair_s: float = 0.0
    """Seconds for each rollout and each actor there is: looking at all actors whenever one of them is done."""

    def seconds(self, num_actors: int, num_worlds: float) -> float:
        """Seconds of an update.

        Args:
            num_actors: so many rollouts.
            num_worlds: of each actor.
        """
        each = self.rollout_s + num_worlds * self.world_s
        return self.update_s + num_actors * each + num_actors**2 * self.pair_s


@dataclass(frozen=True, slots=True)
class Model:
    """Costs of every part."""

    actor: Cost
    """Cost of one actor for its own rollout."""
    parts: Mapping[str, Cost]
    """Everything there is only one of, by name."""
    env_steps: float
    """Env steps of one world in a round."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """A run with so many actors."""

    num_actors: int
    num_worlds: float
    """Worlds of each actor."""
    seconds: Mapping[str, float]
    """That each part is busy for an update, by name; the actors beside the others."""
    env_steps_per_s: float

    @property
    def update_s(self) -> float:
        """From one update to the next."""
        return max(self.seconds.values())

    @property
    def num_cores(self) -> int:
        """One for every actor, and one for the learner."""
        return self.num_actors + 1

    @property
    def bottleneck(self) -> str:
        """The slowest part."""
        return max(self.seconds, key=lambda name: self.seconds[name])

    def busy(self, name: str) -> float:
        """Share of the time in which a part works."""
        return self.seconds[name] / self.update_s


def predict(model: Model, num_actors: int, num_worlds: float) -> Prediction:
    """Predict a run with ``num_actors`` of ``num_worlds`` each."""
    seconds = {ACTORS: model.actor.seconds(1, num_worlds)}
    seconds |= {name: cost.seconds(num_actors, num_worlds) for name, cost in model.parts.items()}
    steps = num_actors * num_worlds * model.env_steps
    return Prediction(num_actors, num_worlds, seconds, steps / max(seconds.values()))


@dataclass(frozen=True, slots=True)
class Batch:
    """A size of update, and how many of them a skill takes."""

    num_worlds: int
    """Of all actors together."""
    num_updates: float


@dataclass(frozen=True, slots=True)
class Skill:
    """The way to a skill on so many cores."""

    batch: Batch
    run: Prediction

    @property
    def seconds(self) -> float:
        """Until the skill is there."""
        return self.batch.num_updates * self.run.update_s


def fastest(model: Model, batches: Iterable[Batch], num_cores: int) -> Skill:
    """The fastest way to a skill on ``num_cores``: which batch, how many actors. Cores may be left over."""
    ways = (
        Skill(batch, predict(model, num_actors, batch.num_worlds / num_actors))
        for batch in batches
        for num_actors in range(1, min(num_cores - 1, batch.num_worlds) + 1)
    )
    return min(ways, key=lambda way: (way.seconds, way.run.num_cores))


def limit(model: Model, part: str, num_worlds: float) -> int | None:
    """The most actors that a part keeps up with: with one more it takes longer for an update than they do.

    Returns:
        None: more than ``MAX_ACTORS``.
    """
    cost, actor_s = model.parts[part], model.actor.seconds(1, num_worlds)
    low, high = 0, MAX_ACTORS
    if cost.seconds(high, num_worlds) <= actor_s:
        return None
    while high - low > 1:
        middle = (low + high) // 2
        if cost.seconds(middle, num_worlds) <= actor_s:
            low = middle
        else:
            high = middle
    return low
