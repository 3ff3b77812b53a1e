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

import service.cluster.worker_variables  # noqa: F401  before NumPy and MuJoCo are imported  # isort: split
from service.actors.rollout import Rollout
from service.base.liveness import count_work, work_done
from service.base.types import Arrays
from service.config.self_play import SelfPlayConfig
from service.generator.opponents import Opponents
from service.generator.records import GoalSummary
from service.generator.snapshot import GeneratorSnapshot
from service.methods.workers import (
    GeneratorResult,
    GeneratorWorker,
    LearnerWorker,
    RolloutWorker,
    RoundSummary,
    UpdateResult,
)
from service.store.models import GoalGrid

if TYPE_CHECKING:
    from service.learner.weights import Weights

NICENESS = 10
"""Of workers that compute, above that of processes that answer: a tenth of the share of a core that both want."""


QUIET = {"enable_task_events": False}
"""Else Ray's head keeps the last 100,000 calls, some 350 MB: a run makes as many in half a day."""
PROBE_GROUP = {"probe": 1}
"""Concurrency groups of all workers: a thread beside the one that works, which answers ``progress``."""


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


def remote_actor(kind: type[Watched], **options: Any) -> Any:
    """Ray's actor class of a worker, with options of its own beside those that all have."""
    actor = ray.remote(concurrency_groups=PROBE_GROUP)(kind)  # type: ignore[call-overload]
    return actor.options(**QUIET, **options)


class Watched:
    """A worker that can be asked for its progress while it works."""

    def ping(self) -> Location:
        """The worker's location."""
        return Location.here()

    @ray.method(concurrency_group="probe")
    def progress(self) -> int:
        """Work that the thread beside this one has done, see ``liveness``."""
        return work_done()


class RolloutActor(RolloutWorker, Watched):
    """A rollout worker in a process of its own."""

    def __init__(self, config: SelfPlayConfig, actor: int, incarnation: int, num_threads: int) -> None:
        lower_priority()
        super().__init__(config, actor, incarnation, num_threads=num_threads)
        self._count = _round_counters(actor)

    def play_round(
        self, weights: Weights, snapshot: GeneratorSnapshot, opponents: Opponents, num_rounds: int
    ) -> tuple[Rollout, GoalSummary, RoundSummary]:
        """Play a round in every world; see ``RolloutWorker.play``."""
        played = self.play(weights, snapshot, opponents, num_rounds)
        self._count(played[-1])
        return played


class GeneratorActor(GeneratorWorker, Watched):
    """A task generator that hands its whole state back with every record."""

    def start(self, references: Sequence[Any]) -> Location:
        """Continue from a state, given as the only one of the object references; see ``RemoteWorker``."""
        (state,) = _fetch(references)
        if state is not None:
            self.generator.load_state(state)
        return self.ping()

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
        result = self.record(iteration, weights, _fetch(references))
        opponents = self.opponents() if result.new_opponents else None
        grid = self.grid(iteration + 1, num_env_steps)
        return (result, grid), self.generator.state(), self.generator.snapshot(), opponents


class LearnerActor(Watched):
    """The learner, which hands its whole state back with every update."""

    def __init__(self, config: SelfPlayConfig) -> None:
        lower_priority()
        self._config = config

    def start(self, references: Sequence[Any]) -> Location:
        """Continue from a state, given as the only one of the object references; see ``RemoteWorker``.

        Raises:
            LearnerError: the state does not fit, or a device is not there.
        """
        (state,) = _fetch(references)
        self._worker = LearnerWorker(self._config, state)
        return self.ping()

    def begin(self) -> tuple[Weights, Arrays]:
        """Weights and state before the first update."""
        return self._worker.learner.weights(), self._worker.learner.state()

    def update_from(self, references: Sequence[Any]) -> tuple[UpdateResult, Weights, Arrays]:
        """Learn from rollouts, given as object references; see ``LearnerWorker.update``."""
        start = time.perf_counter()
        result = self._worker.update(_fetch(references))
        weights, state = self.begin()
        return replace(result, update_s=time.perf_counter() - start), weights, state  # all that an actor waits for


def _fetch(references: Sequence[Any]) -> list[Any]:
    """What references are of, one after the other: each that has come is progress."""
    found = []
    for reference in references:
        found.append(ray.get(reference))
        count_work()
    return found


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
