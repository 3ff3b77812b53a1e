"""The workers of a run as Ray actors: each in a process of its own.

They add to the plain ``workers`` what only another process needs: a ping, arguments that come as object references,
whole states that are handed back, and Prometheus counters.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import ray
from ray.util.metrics import Counter, Histogram

from service.actors.rollout import Rollout
from service.config import Config
from service.generator.opponents import Opponents
from service.generator.snapshot import GeneratorSnapshot
from service.generator.summary import GoalSummary
from service.runtime.workers import (
    GeneratorResult,
    GeneratorWorker,
    LearnerWorker,
    RolloutWorker,
    RoundSummary,
    UpdateResult,
)
from service.store.models import GoalGrid
from service.types import Arrays

if TYPE_CHECKING:
    from service.learner.weights import Weights

NICENESS = 10
"""Of workers that compute, above that of processes that answer: a tenth of the share of a core that both want."""


@dataclass(frozen=True, slots=True)
class Location:
    """The host and process of a worker."""

    node: str
    pid: int

    @classmethod
    def here(cls) -> Location:
        """The location of this process."""
        return cls(socket.gethostname(), os.getpid())


def lower_priority() -> None:
    """Put a process that computes all the time behind those that answer: driver, status service, Redis, Ray itself.

    To be called before threads are started; they inherit it.
    """
    if hasattr(os, "nice"):
        os.nice(NICENESS)


class RolloutActor(RolloutWorker):
    """A rollout worker in a process of its own."""

    def __init__(self, config: Config, actor: int, incarnation: int, num_threads: int) -> None:
        lower_priority()
        super().__init__(config, actor, incarnation, num_threads=num_threads)
        self._count = _round_counters(actor)

    def ping(self) -> Location:
        """The worker's location."""
        return Location.here()

    def play_round(
        self, weights: Weights, snapshot: GeneratorSnapshot, opponents: Opponents, num_rounds: int
    ) -> tuple[Rollout, GoalSummary, RoundSummary]:
        """Play a round in every world; see ``RolloutWorker.play``."""
        played = self.play(weights, snapshot, opponents, num_rounds)
        self._count(played[-1])
        return played


class GeneratorActor(GeneratorWorker):
    """A task generator that hands its whole state back with every record."""

    def ping(self) -> Location:
        """The worker's location."""
        return Location.here()

    def begin(self) -> tuple[Arrays, GeneratorSnapshot, Opponents]:
        """State, snapshot and past players before the first iteration."""
        return self.generator.state(), self.generator.snapshot(), self.opponents()

    def record_from(
        self, iteration: int, num_env_steps: int, weights: Weights, references: Sequence[Any]
    ) -> tuple[tuple[GeneratorResult, GoalGrid], Arrays, GeneratorSnapshot, Opponents | None]:
        """Learn from an iteration's goals, given as object references; see ``GeneratorWorker.record``.

        Returns:
            The result with the goal grid after it, the generator's whole state, a snapshot for the next rounds, and
            the past players if there are others than before.
        """
        result = self.record(iteration, weights, ray.get(list(references)))
        opponents = self.opponents() if result.new_opponents else None
        grid = self.grid(iteration + 1, num_env_steps)
        return (result, grid), self.generator.state(), self.generator.snapshot(), opponents


class LearnerActor(LearnerWorker):
    """A learner that hands its whole state back with every update."""

    def __init__(self, config: Config, state: Arrays | None, pending: Rollout | None = None) -> None:
        lower_priority()
        super().__init__(config, state, pending)

    def ping(self) -> Location:
        """The worker's location."""
        return Location.here()

    def begin(self) -> tuple[Weights, Arrays]:
        """Weights and state before the first update."""
        return self.learner.weights(), self.learner.state()

    def update_from(self, references: Sequence[Any]) -> tuple[Weights, Arrays, UpdateResult]:
        """Learn from rollouts, given as object references; see ``LearnerWorker.update``."""
        start = time.perf_counter()
        result = self.update(ray.get(list(references)))
        weights, state = self.learner.weights(), self.learner.state()
        return weights, state, replace(result, update_s=time.perf_counter() - start)  # all that an actor waits for


def _round_counters(actor: int) -> Callable[[RoundSummary], None]:
    """Counters of an actor's rounds for Prometheus, on the metrics port of its node (``ray_tandem_...``)."""
    tags = {"actor": str(actor)}
    steps = Counter("tandem_actor_env_steps", "Env steps simulated.", tag_keys=("actor",))
    rounds = Counter("tandem_actor_rounds", "Rounds played.", tag_keys=("actor",))
    seconds = Histogram(
        "tandem_actor_round_seconds", "Duration of a round.", boundaries=[0.5, 1, 2, 5, 10, 30], tag_keys=("actor",)
    )

    def count(summary: RoundSummary) -> None:
        steps.inc(summary.num_env_steps, tags)
        rounds.inc(1, tags)
        seconds.observe(summary.play_s, tags)

    return count
