"""The pool of rollout actors: starting them, counting them, replacing those that died or hang, and who is late."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import ray

from service.cluster.ray_actors import Location, RolloutActor, remote_actor
from service.cluster.watch import Clock, Watch
from service.config.self_play import SelfPlayConfig
from service.methods.workers import RoundSummary
from service.store.models import ActorStatus

START_GRACE_S = 30.0
"""An actor that has not started for so long waits for a free core; updates no longer count on it."""
RESTART_S = 120.0
"""An actor that has not started for so long is started anew, as it may hang there; each time it gets twice as long."""
LATE_ROUNDS, LATE_S = 3.0, 2.0
"""An actor is late when its round takes this many times its recent ones, and ``LATE_S`` more."""


@dataclass(slots=True)
class ActorSlot:
    """A place in the pool, and one incarnation of the actor that has it."""

    index: int
    incarnation: int
    handle: Any
    spawned: float
    """By the clock of the driver."""
    watch: Watch
    may_start_s: float = RESTART_S
    """Time from which on it is started anew."""
    num_rollouts: int = 0
    num_env_steps: int = 0
    last_error: str | None = None
    location: Location | None = None
    """None until it has started."""
    ticket: int | None = None
    """Rollout slot of the round it plays."""
    round_started: float = 0.0
    """``time.monotonic()``."""
    rounds_s: deque[float] = field(default_factory=lambda: deque(maxlen=10))
    """Durations of its last rounds."""
    num_evaluations: int = 0
    """Evaluations that it was asked for and has not answered."""
    late: bool = False
    """Whether updates go on without the round it plays."""

    @property
    def alive(self) -> bool:
        """Whether it has started."""
        return self.location is not None

    @property
    def idle(self) -> bool:
        """Whether it has started and plays no round."""
        return self.alive and self.ticket is None

    def start_round(self, ticket: int) -> None:
        """Note that it was given a round."""
        self.ticket, self.round_started = ticket, time.monotonic()
        self.watch.begin()

    def finish_round(self, summary: RoundSummary) -> None:
        """Note that it has played its round."""
        self.ticket, self.late = None, False
        self.rounds_s.append(time.monotonic() - self.round_started)
        self.num_rollouts += 1
        self.num_env_steps += summary.num_env_steps
        self.watch.end()

    def start_evaluation(self) -> None:
        """Note that it was asked to evaluate Bob, which it does before the next round."""
        self.num_evaluations += 1
        self.watch.begin()

    def finish_evaluation(self) -> None:
        """Note that it has; only now its round begins."""
        self.num_evaluations -= 1
        self.round_started = time.monotonic()
        self.watch.end()

    @property
    def overdue(self) -> bool:
        """Whether its round takes far longer than its last ones did; of its first one that is not known."""
        if self.ticket is None or self.num_evaluations or not self.rounds_s:
            return False
        return self.watch.call_s > LATE_ROUNDS * median(self.rounds_s) + LATE_S

    def status(self) -> ActorStatus:
        """The slot's state for the status service."""
        counted = {"num_rollouts": self.num_rollouts, "num_env_steps": self.num_env_steps}
        name = f"rollout-{self.index}"
        return self.watch.status(name, self.incarnation, self.location, self.last_error, **counted)


class ActorPool:
    """The rollout actors of a run.

    Args:
        config: the run; ``game.num_worlds`` are one actor's.
        num_threads: of each actor, and as many cores are reserved for it.
        first_incarnation: above that of any actor this run had before, so that no rollout id comes twice.
        clock: of the driver.
    """

    def __init__(self, config: SelfPlayConfig, num_threads: int, first_incarnation: int, clock: Clock) -> None:
        self.num_worlds = config.game.num_worlds
        """Worlds of each actor."""
        self._config, self._num_threads, self._clock = config, num_threads, clock
        self._slots: dict[int, ActorSlot] = {}
        self._incarnations: dict[int, int] = defaultdict(lambda: first_incarnation)
        """The next incarnation of every place; one that goes and comes again begins no rollout id anew."""
        self._actor = remote_actor(RolloutActor, num_cpus=num_threads, max_restarts=0, max_task_retries=0)

    def __iter__(self) -> Iterator[ActorSlot]:
        return iter(self._slots.values())

    def __len__(self) -> int:
        return len(self._slots)

    @property
    def num_alive(self) -> int:
        """Actors that have started."""
        return sum(slot.alive for slot in self)

    @property
    def num_counted_on(self) -> int:
        """Actors that have started, or may any moment, and are not late; at least 1: so many rollouts of an update."""
        now = self._clock.now
        return max(1, sum(not slot.late if slot.alive else now - slot.spawned < START_GRACE_S for slot in self))

    @property
    def late(self) -> list[ActorSlot]:
        """Slots whose round updates do not wait for."""
        return [slot for slot in self if slot.late]

    @property
    def num_waiting(self) -> int:
        """Actors that have not started for long."""
        now = self._clock.now
        return sum(not slot.alive and now - slot.spawned >= START_GRACE_S for slot in self)

    def resize(self, num: int) -> list[ActorSlot]:
        """Have ``num`` slots: new ones get an actor, and of too many those go that wait for a core.

        Returns:
            The new slots.
        """
        for index in sorted(self._slots, reverse=True):
            if len(self._slots) > num and not self._slots[index].alive:
                ray.kill(self._slots.pop(index).handle)
        free = [index for index in range(num) if index not in self._slots]
        new = [self._spawn(index) for index in free[: max(0, num - len(self._slots))]]
        self._slots |= {slot.index: slot for slot in new}
        return new

    def replace(self, slot: ActorSlot, reason: str) -> ActorSlot:
        """Kill a slot's actor and spawn the next incarnation."""
        ray.kill(slot.handle)
        new = self._spawn(slot.index)
        new.num_rollouts, new.num_env_steps, new.last_error = slot.num_rollouts, slot.num_env_steps, reason
        if not slot.alive:
            new.may_start_s = 2.0 * slot.may_start_s
        self._slots[slot.index] = new
        return new

    def holds(self, slot: ActorSlot) -> bool:
        """Whether this very incarnation is still in the pool."""
        return self._slots.get(slot.index) is slot

    def hung(self) -> list[tuple[ActorSlot, str]]:
        """Slots whose actor hangs, in a call or while it starts, and why."""
        reasons = [(slot, slot.watch.look() if slot.alive else self._late_start(slot)) for slot in self]
        return [(slot, reason) for slot, reason in reasons if reason is not None]

    def become_late(self) -> list[ActorSlot]:
        """Find actors whose round is overdue; from now on they are late."""
        new = [slot for slot in self if slot.overdue and not slot.late]
        for slot in new:
            slot.late = True
        return new

    def close(self) -> None:
        """Kill all actors."""
        for slot in self:
            ray.kill(slot.handle)
        self._slots.clear()

    def _spawn(self, index: int) -> ActorSlot:
        incarnation = self._incarnations[index]
        self._incarnations[index] = incarnation + 1
        handle = self._actor.remote(self._config, index, incarnation, self._num_threads)
        return ActorSlot(index, incarnation, handle, self._clock.now, Watch(handle.progress.remote, self._clock))

    def _late_start(self, slot: ActorSlot) -> str | None:
        waited_s = self._clock.now - slot.spawned
        return f"it did not start for {waited_s:.0f} s" if waited_s > slot.may_start_s else None
