"""The rollout actors of a run: who they are, what they do, and who takes the place of one that is gone."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from statistics import median
from typing import Any

import ray
from ray.exceptions import RayError

from service.config import Config
from service.runtime.remote_worker import ANSWER_S
from service.runtime.workers import Place, RolloutWorker, Round
from service.store.models import ActorStatus

THREAD_VARIABLES = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""NumPy's own threads would fight with those that step the worlds and with the other actors."""
QUIET = {"enable_task_events": False}
"""Else Ray's head keeps the last 100,000 calls, some 350 MB: a run makes as many in half a day."""
START_GRACE_S = 30.0
"""An actor that has not come up for so long waits for a free core; updates no longer count on it."""
MIN_DEADLINE_S = 60.0
DEADLINE_ROUNDS = 20.0
"""An actor hangs when its round takes this many times the usual, and at least ``MIN_DEADLINE_S``."""


@dataclass(slots=True)
class Member:
    """One seat among the actors, and the actor that has it now."""

    index: int
    incarnation: int
    handle: Any
    born: float
    """``time.monotonic()``, as all times here that are no dates."""
    num_rollouts: int = 0
    num_env_steps: int = 0
    last_error: str | None = None
    place: Place | None = None
    rng: Any = None
    """Reference to its random numbers as they are after its last round."""
    pool_version: int = -1
    ticket: int | None = None
    began: float = 0.0
    heartbeat: datetime = field(default_factory=lambda: datetime.now(UTC))

    @property
    def idle(self) -> bool:
        """Up, and without a round."""
        return self.place is not None and self.ticket is None

    def joined(self, place: Place, rng: Any) -> None:
        """It is up."""
        self.place, self.rng = place, rng
        self.heartbeat = datetime.now(UTC)

    def begin(self, ticket: int) -> None:
        """It was given a round."""
        self.ticket, self.began = ticket, time.monotonic()

    def finish(self, played: Round, rng: Any) -> None:
        """It has played it."""
        self.ticket, self.rng, self.pool_version = None, rng, played.pool_version
        self.num_rollouts += 1
        self.num_env_steps += played.num_env_steps
        self.heartbeat = datetime.now(UTC)

    def give_up(self) -> None:
        """Its round came to nothing, through no fault of its own."""
        self.ticket = None

    def answers(self) -> bool:
        """Whether it is alive. Only to be asked while it has no round."""
        try:
            ray.get(self.handle.ping.remote(), timeout=ANSWER_S)
        except RayError:
            return False
        return True

    def status(self) -> ActorStatus:
        """For the status service."""
        return ActorStatus(
            name=f"rollout-{self.index}",
            incarnation=self.incarnation,
            state="alive" if self.place is not None else "starting",
            node=self.place.node if self.place is not None else "",
            pid=self.place.pid if self.place is not None else None,
            heartbeat=self.heartbeat,
            num_rollouts=self.num_rollouts,
            num_env_steps=self.num_env_steps,
            last_error=self.last_error,
        )


class Crew:
    """Starts actors, counts them, and replaces those that died or hang.

    Args:
        config: the run; ``game.num_worlds`` are one actor's.
        num_threads: of each actor, and as many cores are reserved for it.
        first_incarnation: above that of any actor this run had before, so that no rollout id comes twice.
    """

    def __init__(self, config: Config, num_threads: int, first_incarnation: int) -> None:
        self._config, self._num_threads, self._incarnation = config, num_threads, first_incarnation
        self._members: dict[int, Member] = {}
        self._round_s: list[float] = []
        self._actor = ray.remote(RolloutWorker).options(
            num_cpus=num_threads,
            max_restarts=0,
            max_task_retries=0,
            runtime_env={"env_vars": THREAD_VARIABLES},
            **QUIET,
        )

    def __iter__(self) -> Iterator[Member]:
        return iter(self._members.values())

    def __len__(self) -> int:
        return len(self._members)

    @property
    def num_counted_on(self) -> int:
        """Actors that are up, or may be any moment; at least 1. So many rollouts make an update."""
        now = time.monotonic()
        return max(1, sum(each.place is not None or now - each.born < START_GRACE_S for each in self))

    @property
    def num_waiting(self) -> int:
        """Actors that have not come up for long."""
        now = time.monotonic()
        return sum(each.place is None and now - each.born >= START_GRACE_S for each in self)

    def resize(self, num: int) -> list[Member]:
        """Have ``num`` seats: new ones get an actor, and of too many those go that wait for a core.

        Returns:
            The members that are new.
        """
        for index in sorted(self._members, reverse=True):
            if len(self._members) > num and self._members[index].place is None:
                self.end(self._members.pop(index))
        new = [index for index in range(num) if index not in self._members]
        for index in new[: max(0, num - len(self._members))]:
            self._members[index] = self._hire(index, self._incarnation)
        return [self._members[index] for index in new if index in self._members]

    def replace(self, member: Member, why: str) -> Member:
        """End a member's actor and give its seat to a new one, of the next incarnation."""
        self.end(member)
        new = self._hire(member.index, member.incarnation + 1)
        new.num_rollouts, new.num_env_steps, new.last_error = member.num_rollouts, member.num_env_steps, why
        self._members[member.index] = new
        return new

    def holds(self, member: Member) -> bool:
        """Whether this very incarnation still has its seat."""
        return self._members.get(member.index) is member

    def took(self, play_s: float) -> None:
        """A round took so long."""
        self._round_s = [*self._round_s[-50:], play_s]

    @property
    def deadline_s(self) -> float:
        """A round that takes longer hangs."""
        usual = median(self._round_s) if self._round_s else 0.0
        return max(MIN_DEADLINE_S, DEADLINE_ROUNDS * usual)

    def hung(self) -> list[Member]:
        """Members whose round is past its deadline."""
        now = time.monotonic()
        return [each for each in self if each.ticket is not None and now - each.began > self.deadline_s]

    def end(self, member: Member) -> None:
        """Kill its actor."""
        ray.kill(member.handle, no_restart=True)

    def close(self) -> None:
        """Kill all."""
        for member in self:
            self.end(member)
        self._members.clear()

    def _hire(self, index: int, incarnation: int) -> Member:
        handle = self._actor.remote(self._config, index, incarnation, self._num_threads)
        return Member(index, incarnation, handle, time.monotonic())
