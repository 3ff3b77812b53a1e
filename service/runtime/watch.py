"""Watches over workers in other processes: which of them hang, by the work that they count while a call takes long.

A process that is frozen does not answer. One that hangs answers, and counts no further. One on a busy machine counts
slowly, and is left alone: a machine that gives it a fiftieth of a core is no reason to kill it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from statistics import median
from typing import Any

import ray
from ray.exceptions import RayError

PROBE_S = 1.0
"""Time between two questions to a worker; a call that has just begun, or has just made progress, needs none."""
STALL_S, MAX_STALL_S = 20.0, 40.0
STALL_CALLS = 10.0
"""A worker hangs without progress for this many times its usual call, between ``STALL_S`` and ``MAX_STALL_S``."""
FIRST_S = 120.0
"""A worker hangs without progress for so long in its first call, in which libraries are loaded and code is compiled."""
ENDLESS_S, ENDLESS_CALLS = 600.0, 100.0
"""And it hangs, whatever it counts, in a call of this many times the usual, and at least ``ENDLESS_S``."""


class Watch:
    """One process of a worker, from its start to its end.

    Args:
        probe: asks it for ``liveness.work_done``, in a thread beside the one that works; returns a reference.
    """

    def __init__(self, probe: Callable[[], Any]) -> None:
        self._probe = probe
        self._durations_s: deque[float] = deque(maxlen=20)
        self._num_calls = 0
        self.heartbeat = datetime.now(UTC)
        """When it last answered a call, or had counted further."""
        self._began = self._moved = self._looked = time.monotonic()
        self._asked: Any = None
        self._count: int | None = None

    def begin(self) -> None:
        """Note that it was given a call."""
        if not self._num_calls:
            self._began = self._moved = time.monotonic()
        self._num_calls += 1

    def end(self) -> None:
        """Note that it has answered a call."""
        now = time.monotonic()
        self._num_calls = max(0, self._num_calls - 1)
        self._durations_s.append(now - self._began)
        self._began = self._moved = now
        self.heartbeat = datetime.now(UTC)

    def forgive(self, seconds: float) -> None:
        """Leave out a time in which the driver did not look, and nothing else may have run."""
        self._began += seconds
        self._moved += seconds

    @property
    def usual_s(self) -> float | None:
        """Duration of a call, the median of the last ones; None before the first."""
        return median(self._durations_s) if self._durations_s else None

    @property
    def bound_s(self) -> float:
        """Time without progress from which on it hangs."""
        if self.usual_s is None:
            return FIRST_S
        return min(max(STALL_S, STALL_CALLS * self.usual_s), max(STALL_S, MAX_STALL_S))

    def look(self) -> str | None:
        """Ask for its progress, or take the answer; returns in a few words why it hangs, if it does."""
        now = time.monotonic()
        if not self._num_calls:
            return None
        if now - self._looked >= PROBE_S and now - self._moved >= PROBE_S:
            self._looked = now
            self._take_answer()
        if now - self._moved > self.bound_s:
            return f"no progress for {now - self._moved:.0f} s"
        if self.usual_s is not None and now - self._began > max(ENDLESS_S, ENDLESS_CALLS * self.usual_s):
            return f"a call that usually takes {self.usual_s:.1f} s has taken {now - self._began:.0f} s"
        return None

    @property
    def silent(self) -> bool:
        """Whether it did not even answer the last question."""
        return self._asked is not None and not _is_ready(self._asked)

    def _take_answer(self) -> None:
        if self._asked is not None:
            if not _is_ready(self._asked):
                return
            try:
                count = ray.get(self._asked)
            except RayError:  # it is gone, and its call fails as well
                return
            if count != self._count:
                self._count, self._moved, self.heartbeat = count, time.monotonic(), datetime.now(UTC)
        self._asked = self._probe()


def _is_ready(reference: Any) -> bool:
    ready, _ = ray.wait([reference], timeout=0)
    return bool(ready)
