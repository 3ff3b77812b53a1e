"""Watches over workers in other processes: which of them hang, by the work that they count while a call takes long.

A process that is frozen does not answer. One that hangs answers, and counts no further. One on a busy machine counts
slowly, and is left alone: a machine that gives it a fiftieth of a core is no reason to kill it.

While the raylet of this machine, Ray's process for a node, is frozen, Ray does nothing here. The driver's own calls
wait in it, too, some of them for ever. So a thread of its own asks it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, Self

import ray
from ray._private.grpc_utils import init_grpc_channel
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
ASK_S = 0.5
"""Time between two questions to the raylet."""
SILENT_S = 5.0
"""A raylet that has not answered for so long may be frozen; until it answers, no other process is called hung."""
LOST_S = 40.0
"""One that has not answered for so long is given up."""


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
        name: of the worker, for people.
        incarnation: which of its processes this is, counted from 0.
        handle: Ray's of the process. It answers ``progress`` in a thread beside the one that works.
        clock: of the driver.
    """

    def __init__(self, name: str, incarnation: int, handle: Any, clock: Clock) -> None:
        self.name, self.incarnation, self.handle, self._clock = name, incarnation, handle, clock
        self.location: Location | None = None
        """None until it has started."""
        self._num_calls = 0
        self._bound_s = FIRST_S
        self.heartbeat = datetime.now(UTC)
        """When it last answered a call, or had counted further."""
        self._began = self._moved = self._looked = clock.now
        self._asked: Any = None
        self._count: int | None = None

    def status(self, last_error: str | None, **counted: int) -> ActorStatus:
        """The worker's state for the status service; ``last_error`` is why its last process ended."""
        return ActorStatus(
            name=self.name,
            incarnation=self.incarnation,
            state="starting" if self.location is None else "alive",
            last_error=last_error,
            heartbeat=self.heartbeat,
            **(self.location or {}),
            **counted,
        )

    def begin(self) -> None:
        """Note that it was given a call."""
        if not self._num_calls:
            self._began = self._moved = self._clock.now
        self._num_calls += 1

    def end(self) -> None:
        """Note that it has answered a call."""
        self._num_calls -= 1
        self._bound_s = STALL_S
        self._began = self._moved = self._clock.now
        self.heartbeat = datetime.now(UTC)

    @property
    def call_s(self) -> float:
        """Time since its call began, or since the worker was made where there was none."""
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
        self._asked = self.handle.progress.remote()


class RayletWatch:
    """A context manager that asks the raylet of this node again and again whether it is well.

    Args:
        on_lost: called once, in a thread, with a line that says so when the raylet is given up.
    """

    def __init__(self, on_lost: Callable[[str], None]) -> None:
        own = ray.get_runtime_context().get_node_id()
        node = next(each for each in ray.nodes() if each["NodeID"] == own)
        self._on_lost = on_lost
        self._channel = init_grpc_channel(f"{node['NodeManagerAddress']}:{node['NodeManagerPort']}")
        self._over = Event()
        self.answers = False
        """Whether it has ever answered; one that has not may be out of reach, and well."""
        self.silent = False
        """Whether it has not answered for some seconds."""
        self._thread = Thread(target=self._watch, name="raylet", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()
        self._channel.close()

    def _watch(self) -> None:
        ask = self._channel.unary_unary("/grpc.health.v1.Health/Check")
        clock, answer = Clock(), ask.future(b"")
        while not self._over.wait(ASK_S):
            clock.look()
            if answer.done():
                if answer.exception() is None:
                    clock, self.answers = Clock(), True
                answer = ask.future(b"")
            self.silent = self.answers and clock.now > SILENT_S
            if self.answers and clock.now > LOST_S:
                self._on_lost(f"Ray's process for this machine, the raylet, has not answered for {clock.now:.0f} s")
                return
