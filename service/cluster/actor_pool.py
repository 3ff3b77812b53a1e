"""The pool of rollout actors: starting them, counting them, replacing those that died or hang, and who is late."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import ray

from service.base.types import Metrics
from service.cluster.iteration import Round
from service.cluster.ray_actors import RolloutActor, remote_actor
from service.cluster.watch import Clock, Watch
from service.config.self_play import SelfPlayConfig
from service.envs.sampling import GoalKind
from service.store.models import ActorStatus

START_GRACE_S = 30.0
"""An actor that has not started for so long waits for a free core; updates no longer count on it."""
RESTART_S = 120.0
"""An actor that has not started for so long is started anew, as it may hang there; each time it gets twice as long."""
LATE_ROUNDS, LATE_S = 3.0, 2.0
"""An actor is late when its round takes this many times its recent ones, and ``LATE_S`` more."""


@dataclass(slots=True, eq=False)
class ActorSlot:
    """A place in the pool, and one incarnation of the actor that has it."""

    index: int
    starting: Any
    """Reference to its location, which comes when it has started; None from then on."""
    watch: Watch
    may_start_s: float = RESTART_S
    """Time from which on it is started anew."""
    num_rollouts: int = 0
    num_env_steps: int = 0
    num_replaced: int = 0
    """Actors that failed in this place."""
    last_error: str | None = None
    round: Round | None = None
    """The round it plays."""
    rounds_s: deque[float] = field(default_factory=lambda: deque(maxlen=10))
    """Durations of its last rounds."""
    evaluations: list[Any] = field(default_factory=list)
    """References to evaluations that it was asked for and has not answered."""
    late: bool = False
    """Whether updates go on without the round it plays."""

    @property
    def alive(self) -> bool:
        """Whether it has started."""
        return self.watch.location is not None

    @property
    def waits(self) -> bool:
        """Whether it has not started for long: it waits for a free core."""
        return not self.alive and self.watch.call_s >= START_GRACE_S

    def look(self) -> str | None:
        """Look after it; returns in a few words why it hangs, in a call or while it starts, if it does."""
        if self.alive:
            return self.watch.look()
        waited_s = self.watch.call_s
        return f"it did not start for {waited_s:.0f} s" if waited_s > self.may_start_s else None

    def start_round(self, version: int, weights: Any, snapshot: Any, opponents: Any, num_rounds: int) -> None:
        """Give it a round, which takes references; see ``RolloutWorker.play``."""
        references = self.watch.handle.play_round.remote(weights, snapshot, opponents, num_rounds)
        self.round = Round(version, weights, *references)
        self.watch.begin()

    def finish_round(self) -> Round:
        """Take the round that it has played.

        Raises:
            Exception: whatever happened on another machine.
        """
        assert self.round is not None
        played, self.round, self.late = self.round, None, False
        self.watch.end()
        played.summary = ray.get(played.answer)
        seconds = time.monotonic() - played.started
        played.hand_over_s = seconds - played.summary.play_s
        self.rounds_s.append(seconds)
        self.num_rollouts += 1
        self.num_env_steps += played.summary.num_env_steps
        return played

    def start_evaluation(self, weights: Any, kind: GoalKind) -> None:
        """Ask it to evaluate Bob, which it does before the next round."""
        self.evaluations.append(self.watch.handle.evaluate.remote(weights, [kind]))
        self.watch.begin()

    def finish_evaluation(self, reference: Any) -> Metrics:
        """Take an evaluation; only now its round begins.

        Raises:
            Exception: whatever happened on another machine.
        """
        self.evaluations.remove(reference)
        if self.round is not None:
            self.round.started = time.monotonic()
        self.watch.end()
        found: Metrics = ray.get(reference)
        return found

    @property
    def overdue(self) -> bool:
        """Whether its round takes far longer than its last ones did; of its first one that is not known."""
        if self.round is None or self.evaluations or not self.rounds_s:
            return False
        return self.watch.call_s > LATE_ROUNDS * median(self.rounds_s) + LATE_S

    def status(self) -> ActorStatus:
        """The slot's state for the status service."""
        names = "num_rollouts", "num_env_steps", "num_replaced"
        return self.watch.status(self.last_error, **{name: getattr(self, name) for name in names})


class ActorPool:
    """The rollout actors of a run.

    Args:
        config: the run; ``game.num_worlds`` are one actor's.
        num_threads: of each actor, and as many cores are reserved for it.
        first_incarnation: above that of any actor this run had before, so that no rollout id comes twice.
        clock: of the driver.
    """

    def __init__(self, config: SelfPlayConfig, num_threads: int, first_incarnation: int, clock: Clock) -> None:
        self.config, self._num_threads, self._clock = config, num_threads, clock
        self._slots: dict[int, ActorSlot] = {}
        self._incarnations: dict[int, int] = defaultdict(lambda: first_incarnation)
        """The next incarnation of every place; one that goes and comes again begins no rollout id anew."""
        self._actor = remote_actor(RolloutActor, num_cpus=num_threads, max_restarts=0, max_task_retries=0)

    def __iter__(self) -> Iterator[ActorSlot]:
        return iter(self._slots.values())

    def __len__(self) -> int:
        return len(self._slots)

    @property
    def next_incarnation(self) -> int:
        """Above that of all actors so far."""
        return max(self._incarnations.values())

    @property
    def awaited(self) -> list[Any]:
        """References to everything that its actors have yet to answer."""
        starting = [slot.starting for slot in self if not slot.alive]
        rounds = [slot.round.answer for slot in self if slot.round is not None]
        return [*starting, *rounds, *(each for slot in self for each in slot.evaluations)]

    @property
    def num_counted_on(self) -> int:
        """Actors that have started, or may any moment, and are not late; at least 1: so many rollouts of an update."""
        return max(1, sum(not (slot.late or slot.waits) for slot in self))

    @property
    def rounds(self) -> list[Round]:
        """Rounds being played that updates wait for."""
        return [slot.round for slot in self if slot.round is not None and not slot.late]

    def resize(self, num: int) -> None:
        """Have ``num`` slots: new ones get an actor, and of too many those go that wait for a core."""
        for index in sorted(self._slots, reverse=True):
            if len(self._slots) > num and not self._slots[index].alive:
                ray.kill(self._slots.pop(index).watch.handle)
        free = [index for index in range(num) if index not in self._slots]
        self._slots |= {index: self._spawn(index) for index in free[: max(0, num - len(self._slots))]}

    def replace(self, slot: ActorSlot, reason: str | None) -> None:
        """Kill a slot's actor and spawn the next incarnation.

        Args:
            slot: whose actor it is.
            reason: why it failed; None: it only has not started. Its incarnation made no rollout, and comes again.
        """
        ray.kill(slot.watch.handle)
        if reason is None:
            self._incarnations[slot.index] = slot.watch.incarnation
        new = self._spawn(slot.index)
        new.num_rollouts, new.num_env_steps = slot.num_rollouts, slot.num_env_steps
        new.num_replaced = slot.num_replaced + (reason is not None)
        new.last_error = reason or slot.last_error
        if not slot.alive:
            new.may_start_s = 2.0 * slot.may_start_s
        self._slots[slot.index] = new

    def close(self) -> None:
        """Kill all actors."""
        for slot in self:
            ray.kill(slot.watch.handle)
        self._slots.clear()

    def _spawn(self, index: int) -> ActorSlot:
        incarnation = self._incarnations[index]
        self._incarnations[index] = incarnation + 1
        handle = self._actor.remote(self.config, index, incarnation, self._num_threads)
        return ActorSlot(index, handle.ping.remote(), Watch(f"rollout-{index}", incarnation, handle, self._clock))
