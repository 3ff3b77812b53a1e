"""The workers of a run as Ray actors: each in a process of its own.

They add to the plain ``workers`` what only another process needs: a ping, arguments that come as object references,
whole states that are handed back, and Prometheus counters.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import ray
from ray.util.metrics import Counter, Histogram

import service.cluster.worker_variables  # noqa: F401  before NumPy and MuJoCo are imported  # isort: split
from service.actors.rollout import Rollout, Weights
from service.base.liveness import count_work, work_done
from service.base.types import Arrays, Metrics
from service.config.self_play import SelfPlayConfig
from service.generator.opponents import Opponents
from service.generator.records import GoalSummary
from service.generator.snapshot import GeneratorSnapshot
from service.methods.method import Iteration
from service.methods.workers import GeneratorWorker, RolloutWorker, RoundSummary
from service.store.models import GoalGrid

if TYPE_CHECKING:
    from service.learner.learner import Learner

NICENESS = 10
"""Of workers that compute all the time, above that of processes that answer: driver, status service, Redis, Ray itself.

They get a tenth of the share of a core that both want. Threads inherit it, so it is set before they are started.
"""


QUIET = {"enable_task_events": False}
"""Else Ray's head keeps the last 100,000 calls, some 350 MB: a run makes as many in half a day."""
PROBE_GROUP = {"probe": 1}
"""Concurrency groups of all workers: a thread beside the one that works, which answers ``progress``."""


Location = dict[str, Any]
"""The host and process of a worker: ``node`` and ``pid``."""


def remote_actor(kind: type[Watched], **options: Any) -> Any:
    """Ray's actor class of a worker, with options of its own beside those that all have."""
    actor = ray.remote(concurrency_groups=PROBE_GROUP)(kind)  # type: ignore[call-overload]
    return actor.options(**QUIET, **options)


class Watched:
    """A worker that can be asked for its progress while it works."""

    def ping(self) -> Location:
        """The worker's location."""
        return {"node": socket.gethostname(), "pid": os.getpid()}

    @ray.method(concurrency_group="probe")
    def progress(self) -> int:
        """Work that the thread beside this one has done, see ``liveness``."""
        return work_done()


class RolloutActor(RolloutWorker, Watched):
    """A rollout worker in a process of its own."""

    def __init__(self, config: SelfPlayConfig, actor: int, incarnation: int, num_threads: int) -> None:
        os.nice(NICENESS)
        super().__init__(config, actor, incarnation, num_threads=num_threads)
        self._count = _round_counters(actor)

    @ray.method(num_returns=3)
    def play_round(
        self, weights: Weights, snapshot: GeneratorSnapshot, opponents: Opponents, num_rounds: int
    ) -> tuple[Rollout, GoalSummary, RoundSummary]:
        """Play a round in every world; see ``RolloutWorker.play``."""
        played = self.play(weights, snapshot, opponents, num_rounds)
        self._count(played[-1])
        return played


class GeneratorActor(GeneratorWorker, Watched):
    """A task generator that hands its whole state back with every record."""

    @ray.method(num_returns=5)
    def start(self, references: Sequence[Any]) -> tuple[Location, Arrays, GeneratorSnapshot, bool, Opponents]:
        """Continue from a state, given as the only one of the object references.

        Returns:
            Where it is, and its state, snapshot, whether the run should stop, and past players before the next
            iteration.
        """
        (state,) = _fetch(references)
        if state is not None:
            self.generator.load_state(state)
        made = self.generator.state(), self.generator.snapshot(), self.generator.should_stop()
        return self.ping(), *made, self.generator.opponents

    @ray.method(num_returns=5)
    def record_from(
        self, iteration: int, num_env_steps: int, weights: Weights, references: Sequence[Any]
    ) -> tuple[tuple[Iteration, GoalGrid, bool], Arrays, GeneratorSnapshot, bool, Opponents | None]:
        """Learn from an iteration's goals, given as object references; see ``GeneratorWorker.record``.

        Returns:
            Its part of the iteration with the goal grid after it and whether there are other past players; then what
            ``start`` gives beside the location, with None for past players that are the same.
        """
        before = self.generator.opponents.version
        recorded = self.record(iteration, weights, _fetch(references))
        opponents = self.generator.opponents
        has_new = opponents.version != before
        made = self.generator.state(), self.generator.snapshot(), self.generator.should_stop()
        return (recorded, self.grid(iteration + 1, num_env_steps), has_new), *made, opponents if has_new else None


class LearnerActor(Watched):
    """The learner, which hands its whole state back with every update."""

    _learner: Learner

    def __init__(self, config: SelfPlayConfig) -> None:
        os.nice(NICENESS)
        self._config = config

    @ray.method(num_returns=3)
    def start(self, references: Sequence[Any]) -> tuple[Location, Weights, Arrays]:
        """Continue from a state, given as the only one of the object references.

        Returns:
            Where it is, and its weights and state before the next update.

        Raises:
            ConfigError: a device is not there.
        """
        from service.learner.learner import Learner  # torch, which no other worker needs

        (state,) = _fetch(references)
        self._learner = Learner(self._config)
        if state is not None:
            self._learner.load_state(state)
        return self.ping(), self._learner.weights(), self._learner.state()

    @ray.method(num_returns=3)
    def update_from(self, references: Sequence[Any]) -> tuple[tuple[Metrics, list[bool]], Weights, Arrays]:
        """Learn from rollouts, given as object references; see ``Learner.update``.

        Returns:
            Metrics and whether each rollout was learned from, then the weights and the whole state after it.
        """
        start = time.perf_counter()
        taken = [self._learner.ingest(rollout) for rollout in _fetch(references)]
        metrics = self._learner.update()
        weights, state = self._learner.weights(), self._learner.state()
        return (metrics | {"time/learn_s": time.perf_counter() - start}, taken), weights, state


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
