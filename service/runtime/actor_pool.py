"""The pool of rollout actors: starting them, counting them, and replacing those that died or hang."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from statistics import median
from typing import Any

import ray

from service.config import Config
from service.runtime.ray_actors import Location, RolloutActor
from service.runtime.workers import RoundSummary
from service.store.models import ActorStatus

THREAD_VARIABLES = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""NumPy's own threads would fight with those that step the worlds and with the other actors."""
QUIET = {"enable_task_events": False}
"""Else Ray's head keeps the last 100,000 calls, some 350 MB: a run makes as many in half a day."""
START_GRACE_S = 30.0
"""An actor that has not started for so long waits for a free core; updates no longer count on it."""
MIN_DEADLINE_S = 60.0
DEADLINE_ROUNDS = 20.0
"""An actor hangs when its round takes this many times the usual, and at least ``MIN_DEADLINE_S``."""


@dataclass(slots=True)
class ActorSlot:
    """A place in the pool, and one incarnation of the actor that has it."""

    index: int
    incarnation: int
    handle: Any
    spawned: float
    """``time.monotonic()``, as all times here that are no dates."""
    num_rollouts: int = 0
    num_env_steps: int = 0
    last_error: str | None = None
    location: Location | None = None
    """None until it has started."""
    ticket: int | None = None
    """Rollout slot of the round it plays."""
    round_started: float = 0.0
    heartbeat: datetime = field(default_factory=lambda: datetime.now(UTC))

    @property
    def alive(self) -> bool:
        """Whether it has started."""
        return self.location is not None

    @property
    def idle(self) -> bool:
        """Whether it has started and plays no round."""
        return self.alive and self.ticket is None

    def join(self, location: Location) -> None:
        """Note that it has started."""
        self.location = location
        self.heartbeat = datetime.now(UTC)

    def start_round(self, ticket: int) -> None:
        """Note that it was given a round."""
        self.ticket, self.round_started = ticket, time.monotonic()

    def finish_round(self, summary: RoundSummary) -> None:
        """Note that it has played its round."""
        self.ticket = None
        self.num_rollouts += 1
        self.num_env_steps += summary.num_env_steps
        self.heartbeat = datetime.now(UTC)

    def status(self) -> ActorStatus:
        """The slot's state for the status service."""
        return ActorStatus(
            name=f"rollout-{self.index}",
            incarnation=self.incarnation,
            state="alive" if self.location is not None else "starting",
            node=self.location.node if self.location is not None else "",
            pid=self.location.pid if self.location is not None else None,
            heartbeat=self.heartbeat,
            num_rollouts=self.num_rollouts,
            num_env_steps=self.num_env_steps,
            last_error=self.last_error,
        )


class ActorPool:
    """The rollout actors of a run.

    Args:
        config: the run; ``game.num_worlds`` are one actor's.
        num_threads: of each actor, and as many cores are reserved for it.
        first_incarnation: above that of any actor this run had before, so that no rollout id comes twice.
    """

    def __init__(self, config: Config, num_threads: int, first_incarnation: int) -> None:
        self.num_worlds = config.game.num_worlds
        """Worlds of each actor."""
        self._config, self._num_threads, self._incarnation = config, num_threads, first_incarnation
        self._slots: dict[int, ActorSlot] = {}
        self._durations_s: list[float] = []
        self._actor = ray.remote(RolloutActor).options(
            num_cpus=num_threads,
            max_restarts=0,
            max_task_retries=0,
            runtime_env={"env_vars": THREAD_VARIABLES},
            **QUIET,
        )

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
        """Actors that have started, or may any moment; at least 1. So many rollouts make an update."""
        now = time.monotonic()
        return max(1, sum(slot.alive or now - slot.spawned < START_GRACE_S for slot in self))

    @property
    def num_waiting(self) -> int:
        """Actors that have not started for long."""
        now = time.monotonic()
        return sum(not slot.alive and now - slot.spawned >= START_GRACE_S for slot in self)

    def resize(self, num: int) -> list[ActorSlot]:
        """Have ``num`` slots: new ones get an actor, and of too many those go that wait for a core.

        Returns:
            The new slots.
        """
        for index in sorted(self._slots, reverse=True):
            if len(self._slots) > num and not self._slots[index].alive:
                self._kill(self._slots.pop(index))
        free = [index for index in range(num) if index not in self._slots]
        new = [self._spawn(index, self._incarnation) for index in free[: max(0, num - len(self._slots))]]
        self._slots |= {slot.index: slot for slot in new}
        return new

    def replace(self, slot: ActorSlot, reason: str) -> ActorSlot:
        """Kill a slot's actor and spawn the next incarnation."""
        self._kill(slot)
        new = self._spawn(slot.index, slot.incarnation + 1)
        new.num_rollouts, new.num_env_steps, new.last_error = slot.num_rollouts, slot.num_env_steps, reason
        self._slots[slot.index] = new
        return new

    def holds(self, slot: ActorSlot) -> bool:
        """Whether this very incarnation is still in the pool."""
        return self._slots.get(slot.index) is slot

    def record_duration(self, play_s: float) -> None:
        """Learn how long rounds usually take."""
        self._durations_s = [*self._durations_s[-50:], play_s]

    @property
    def deadline_s(self) -> float:
        """Duration of a round from which on its actor hangs."""
        usual_s = median(self._durations_s) if self._durations_s else 0.0
        return max(MIN_DEADLINE_S, DEADLINE_ROUNDS * usual_s)

    def hung(self) -> list[ActorSlot]:
        """Slots whose round is past its deadline."""
        now = time.monotonic()
        return [slot for slot in self if slot.ticket is not None and now - slot.round_started > self.deadline_s]

    def close(self) -> None:
        """Kill all actors."""
        for slot in self:
            self._kill(slot)
        self._slots.clear()

    def _kill(self, slot: ActorSlot) -> None:
        ray.kill(slot.handle, no_restart=True)

    def _spawn(self, index: int, incarnation: int) -> ActorSlot:
        handle = self._actor.remote(self._config, index, incarnation, self._num_threads)
        return ActorSlot(index, incarnation, handle, time.monotonic())
