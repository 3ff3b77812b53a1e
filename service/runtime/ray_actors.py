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

import numpy as np
import ray
from ray.util.metrics import Counter, Histogram

from service.actors.rollout import Rollout
from service.config import Config
from service.generator.generator import GoalChoice
from service.generator.records import GoalRecords
from service.runtime.workers import (
    Assignment,
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

GENERATOR_TIMEOUT_S = 30.0
"""The task generator answers within milliseconds, if it is there."""
NICENESS = 10
"""Of workers that compute, above that of processes that answer: a tenth of the share of a core that both want."""


class GeneratorGoneError(RuntimeError):
    """The task generator did not answer in the middle of a round; the round is given up."""


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
    """A rollout worker whose task generator is in another process."""

    def __init__(self, config: Config, actor: int, incarnation: int, num_threads: int) -> None:
        lower_priority()
        super().__init__(config, actor, incarnation, num_threads=num_threads)
        self._count = _round_counters(actor)

    def ping(self) -> tuple[Location, np.random.Generator]:
        """The worker's location and random numbers; the first assignment advances them."""
        return Location.here(), self.rng

    def play_round(
        self, weights: Weights, assignment: Assignment, generator: Any
    ) -> tuple[Rollout, GoalRecords, np.random.Generator, RoundSummary]:
        """Play a round in every world; see ``RolloutWorker.play``.

        Args:
            weights: the policy version to act with.
            assignment: from the task generator, made with this worker's random numbers.
            generator: handle of the task generator.

        Returns:
            The rollout, its records again for the generator, this worker's random numbers, and the round's numbers.

        Raises:
            GeneratorGoneError: the generator died meanwhile; the next round starts from resets.
            DivergedError: a policy no longer acts in finite numbers.
        """

        def choose_goals(*arguments: Any) -> tuple[GoalChoice, np.random.Generator]:
            asked = generator.choose_goals.remote(*arguments)
            try:
                choice, rng = ray.get(asked, timeout=GENERATOR_TIMEOUT_S)
            except (ray.exceptions.RayActorError, ray.exceptions.GetTimeoutError) as error:
                # A RayActorError of the generator must not be taken for the end of this worker.
                raise GeneratorGoneError(f"the task generator did not answer: {type(error).__name__}") from None
            return choice, rng

        try:
            rollout, summary = self.play(weights, assignment, choose_goals)
        except GeneratorGoneError:
            self.game.start_over()
            raise
        self._count(summary)
        return rollout, rollout.records, self.rng, summary


class GeneratorActor(GeneratorWorker):
    """A task generator that hands its whole state back with every record."""

    def ping(self) -> Location:
        """The worker's location."""
        return Location.here()

    def begin(self) -> Arrays:
        """The generator's state before the first iteration."""
        return self.generator.state()

    def record_from(
        self, iteration: int, num_env_steps: int, weights: Weights, references: Sequence[Any]
    ) -> tuple[tuple[GeneratorResult, GoalGrid], Arrays]:
        """Learn from an iteration's goals, given as object references; see ``GeneratorWorker.record``.

        Returns:
            The result with the goal grid after it, and the generator's whole state.
        """
        result = self.record(iteration, weights, ray.get(list(references)))
        return (result, self.grid(iteration + 1, num_env_steps)), self.generator.state()


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
