"""The learner of a cluster: one or several ranks, each in a process of its own, started and ended together.

The driver keeps what each rank handed back. When a rank dies or hangs, there is one thing to do: end all of them, and
start others from that under a new group id, which is the address of a new store.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import ray
from ray.exceptions import GetTimeoutError, RayActorError, RayTaskError

from service.config import Config
from service.errors import TandemError
from service.learner.shares import share_out
from service.runtime.ray_actors import Location
from service.runtime.remote_worker import ANSWER_S, RANK_ANSWER_S, START_S, OnWait, Worker, one_line, wait_for
from service.runtime.runner import ClusterError
from service.runtime.watch import Clock, Watch
from service.runtime.workers import UpdateResult
from service.store.models import ActorStatus
from service.types import Arrays

PING_S = 3.0
"""Ranks that have given up answer within it, and those that died are named."""


@dataclass(slots=True)
class Update:
    """An update on its way through all ranks."""

    weights: Any
    """Reference to the version that comes out of it."""
    states: list[Any]
    """References to the ranks' states after it."""
    answers: list[Any]
    """References to the ranks' results."""
    results: dict[int, UpdateResult] = field(default_factory=dict)
    """Results that are there, by rank."""

    def add(self, rank: int, result: UpdateResult) -> None:
        """Note the result of a rank."""
        self.results[rank] = result

    @property
    def done(self) -> bool:
        """Whether all ranks are."""
        return len(self.results) == len(self.answers)

    def joined(self) -> UpdateResult:
        """The results of all ranks as one; their metrics are equal."""
        results = [self.results[rank] for rank in range(len(self.answers))]
        return UpdateResult(
            results[0].version,
            results[0].metrics,
            tuple(rollout_id for each in results for rollout_id in each.counted),
            tuple(rollout_id for each in results for rollout_id in each.refused),
            max(each.update_s for each in results),
        )


class LearnerGroup(Worker):
    """The ranks of the learner, and all that is needed to start the next ones in their place.

    Args:
        actor: Ray's actor class, with its options.
        config: the run; ``learner.num_learners`` ranks.
        state: one learner's, to start from, or None.
        pending: rollout to be learned from with the first ones.
        clock: of the driver.
        on_wait: called again and again while the driver waits for them to start.
    """

    def __init__(
        self, actor: Any, config: Config, state: Arrays | None, pending: Any, clock: Clock, on_wait: OnWait
    ) -> None:
        super().__init__("learner", clock, on_wait)
        self.size = config.learner.num_learners
        self.locations: list[Location]
        """By rank, once all have started; empty before."""
        self._actor, self._config = actor, config
        self.states: list[Any] = [ray.put(state)] if state is not None else []
        """References to the newest state of each rank; of one learner's after a start from a checkpoint."""
        self._pending = pending
        self._spawn()

    def wait_ready(self) -> None:
        """Wait until all ranks have started, found each other, and loaded the state."""
        try:
            self.locations = self._ask(START_S, self._pings(), "start")
            address = None
            if self.size > 1:
                (address,) = self._ask(ANSWER_S, [self._ranks[0].open_store.remote(RANK_ANSWER_S)], "open a port")
            pending = [self._pending] + [None] * (self.size - 1)  # as one learner would join it: before all others
            started = [
                rank.start.remote(self.states, each, address, RANK_ANSWER_S)
                for rank, each in zip(self._ranks, pending, strict=True)
            ]
            self._ask(START_S, started, "find each other")
        except RayTaskError as error:
            if isinstance(error.cause, TandemError):  # for people; where it was raised is not
                raise ClusterError(str(error.cause)) from None
            raise

    def begin(self) -> list[Any]:
        """References to the weights before the first update, and to the state of each rank."""
        answers = [rank.begin.options(num_returns=2).remote() for rank in self._ranks]
        return [answers[0][0], *(state for _, state in answers)]

    def update(self, rollouts: Sequence[Any]) -> Update:
        """Ask all ranks to learn from their shares of rollouts, given as references in the order of their ids."""
        asked = [
            rank.update_from.options(num_returns=3).remote(list(share_out(rollouts, index, self.size)))
            for index, rank in enumerate(self._ranks)
        ]
        for watch in self._watches:
            watch.begin()
        weights, states, answers = zip(*asked, strict=True)
        return Update(weights[0], list(states), list(answers))

    def keep(self, update: Update) -> None:
        """Go on from the states after an update that is done."""
        self.states, self._pending = update.states, None

    def note_answer(self, rank: int) -> None:
        """Note that a rank has answered an update."""
        self._watches[rank].end()

    def explain(self, error: BaseException) -> str:
        """The reason in a line why an update failed: the ranks that are gone or hang, else the error."""
        if self._hung is not None or self.size == 1:
            return self._hung or one_line(error)
        pings = self._pings()
        ready, _ = ray.wait(pings, num_returns=self.size, timeout=PING_S)
        dead = [rank for rank, ping in enumerate(pings) if ping in ready and _is_dead(ping)]
        return f"{self._describe(dead)} died" if dead else one_line(error)

    def close(self) -> None:
        """Kill all ranks."""
        for rank in self._ranks:
            ray.kill(rank, no_restart=True)

    def statuses(self) -> tuple[ActorStatus, ...]:
        """The ranks' states for the status service."""
        return tuple(
            watch.status(
                self.name if self.size == 1 else f"{self.name}-{rank}",
                self.incarnation,
                self.locations[rank] if self.locations else None,
                self._last_error,
            )
            for rank, watch in enumerate(self._watches)
        )

    def _look(self) -> str | None:
        reason = next(filter(None, [watch.look() for watch in self._watches]), None)
        silent = [rank for rank, watch in enumerate(self._watches) if watch.silent]  # the others wait for it
        return f"{self._describe(silent)}: {reason}" if reason and silent and self.size > 1 else reason

    def _pings(self) -> list[Any]:
        return [rank.ping.remote() for rank in self._ranks]

    def _spawn(self) -> None:
        self._ranks = [self._actor.remote(self._config, rank, self.size) for rank in range(self.size)]
        self.locations = []
        self._watches = [Watch(rank.progress.remote, self._clock) for rank in self._ranks]

    def _ask(self, timeout_s: float, answers: list[Any], what: str) -> list[Any]:
        """Wait for what all ranks were asked."""
        try:
            return wait_for(answers, timeout_s, self._on_wait)
        except GetTimeoutError:
            ready, _ = ray.wait(answers, num_returns=len(answers), timeout=0)
            missing = [rank for rank, answer in enumerate(answers) if answer not in ready]
            ranks = "" if self.size == 1 else f"'s {self._describe(missing)}"
            raise ClusterError(
                f"the {self.name}{ranks} did not {what} within {timeout_s:.0f} s: has the cluster a free core (and "
                "GPU, with learner.device=cuda) for each? see ray status"
            ) from None

    def _describe(self, ranks: Sequence[int]) -> str:
        """Ranks with their nodes, where those are known."""
        nodes = [at.node for at in self.locations] or [""] * self.size
        named = [f"{rank} on {nodes[rank]}" if nodes[rank] else str(rank) for rank in ranks]
        return f"rank{'s' * (len(ranks) > 1)} {' and '.join(named)}"


def check_room(num_learners: int, device: str, cpus: float, actor_threads: int) -> None:
    """Check that a cluster can hold so many ranks and an actor.

    Raises:
        ClusterError: it has too few cores or GPUs; only asked of several ranks.
    """
    there = ray.cluster_resources()
    cores, gpus = there.get("CPU", 0.0), there.get("GPU", 0.0)
    if num_learners > 1 and num_learners * cpus + actor_threads > cores:
        raise ClusterError(
            f"learner.num_learners = {num_learners}: with {cpus:g} cores for each rank and {actor_threads} for an "
            f"actor, the cluster has too few, {cores:g}: add nodes first, or use fewer ranks"
        )
    if num_learners > 1 and device == "cuda" and num_learners > gpus:
        raise ClusterError(
            f"learner.num_learners = {num_learners}: with learner.device=cuda each rank takes a GPU, and the cluster "
            f"has {gpus:g}: use as many ranks as GPUs, or learner.device=cpu"
        )


def num_gpus(device: str, num_learners: int) -> int:
    """GPUs that each rank of the learner asks Ray for; an actor that asks for none sees none."""
    if device == "auto":
        return int(ray.cluster_resources().get("GPU", 0.0) >= num_learners)
    return int(device == "cuda")


def _is_dead(ping: Any) -> bool:
    try:
        ray.get(ping)
    except RayActorError:
        return True
    return False
