"""Watches over workers in other processes: which of them hang, by the work that they count while a call takes long.

A process that is frozen does not answer. One that hangs answers, and counts no further. One on a busy machine counts
slowly, and is left alone: a machine that gives it a fiftieth of a core is no reason to kill it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import ray
from ray.exceptions import RayError

from service.store.models import ActorStatus

if TYPE_CHECKING:
    from service.cluster.ray_actors import Location

LOOK_S = 1.0
"""Most time between two looks of the driver that counts; in more than that it was frozen, or busy."""
PROBE_S = 1.0
"""Time between two questions to a worker; a call that has just begun, or has just made progress, needs none."""
STALL_S = 30.0
"""A worker hangs without progress for so long."""
FIRST_S = 120.0
"""And for so long in its first call, in which libraries are loaded and code is compiled."""


class Clock:
    """Time in which the driver looked after its workers. It stands still while the driver is frozen or busy."""

    def __init__(self) -> None:
        self.now = 0.0
        """Seconds."""
        self._looked = time.monotonic()

    def look(self) -> None:
        """Note that the driver looks now."""
        now = time.monotonic()
        self.now += min(now - self._looked, LOOK_S)
        self._looked = now


class Watch:
    """One process of a worker, from its start to its end.

    Args:
        probe: asks it for ``liveness.work_done``, in a thread beside the one that works; returns a reference.
        clock: of the driver.
    """

    def __init__(self, probe: Callable[[], Any], clock: Clock) -> None:
        self._probe, self._clock = probe, clock
        self._num_calls = 0
        self._bound_s = FIRST_S
        self.heartbeat = datetime.now(UTC)
        """When it last answered a call, or had counted further."""
        self._began = self._moved = self._looked = clock.now
        self._asked: Any = None
        self._count: int | None = None

    def status(
        self, name: str, incarnation: int, location: Location | None, last_error: str | None, **counted: int
    ) -> ActorStatus:
        """The worker's state for the status service; it has no location while it starts."""
        at = {} if location is None else {"node": location.node, "pid": location.pid}
        own = {"name": name, "incarnation": incarnation, "last_error": last_error, "heartbeat": self.heartbeat}
        return ActorStatus(state="starting" if location is None else "alive", **own, **at, **counted)

    def begin(self) -> None:
        """Note that it was given a call."""
        if not self._num_calls:
            self._began = self._moved = self._clock.now
        self._num_calls += 1

    def end(self) -> None:
        """Note that it has answered a call."""
        self._num_calls = max(0, self._num_calls - 1)
        self._bound_s = STALL_S
        self._began = self._moved = self._clock.now
        self.heartbeat = datetime.now(UTC)

    @property
    def call_s(self) -> float:
        """Time since its call began."""
        return self._clock.now - self._began

    def look(self) -> str | None:
        """Ask for its progress, or take the answer; returns in a few words why it hangs, if it does."""
        if not self._num_calls:
            return None
        now = self._clock.now
        if now - self._looked >= PROBE_S and now - self._moved >= PROBE_S:
            self._looked = now
            self._take_answer()
        still_s = now - self._moved
        return f"no progress for {still_s:.0f} s" if still_s > self._bound_s else None

    def _take_answer(self) -> None:
        if self._asked is not None:
            ready, _ = ray.wait([self._asked], timeout=0)
            if not ready:
                return
            try:
                count = ray.get(self._asked)
            except RayError:  # it is gone, and its call fails as well
                return
            if count != self._count:
                self._count, self._moved, self.heartbeat = count, self._clock.now, datetime.now(UTC)
        self._asked = self._probe()
