"""Age of a run's heartbeat, as its reader's own clock counts it: the clocks of two machines may differ, and jump."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from threading import Lock

from service.store.models import ACTIVE, RunStatus

MAX_AHEAD = timedelta(seconds=5)
"""A heartbeat from further in the future says that two clocks differ."""
_MAX_RUNS = 10_000


@dataclass(frozen=True, slots=True)
class _Seen:
    heartbeat: datetime
    beat_s: float
    """``clock`` at the heartbeat, as far as is known."""
    looked_s: float


class Pulse:
    """Remembers when heartbeats changed; for any number of threads at once.

    The first time that a run is asked about, its heartbeat is as old as the clocks say. From then on it grows older by
    this process's own clock, until there is another one.

    Args:
        clock: counts seconds, and never jumps.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, Lock()
        self._seen: dict[str, _Seen] = {}

    def age_s(self, run_id: str, heartbeat: datetime) -> float:
        """Seconds since a run's last heartbeat; never negative."""
        by_date = max(0.0, (datetime.now(UTC) - heartbeat).total_seconds())
        with self._lock:
            now_s, seen = self._clock(), self._seen.get(run_id)
            if seen is None:
                beat_s = now_s - by_date
            elif seen.heartbeat == heartbeat:
                beat_s = seen.beat_s
            else:  # it came at some time since the last look
                beat_s = now_s - min(by_date, now_s - seen.looked_s)
            if len(self._seen) > _MAX_RUNS:
                self._seen.clear()
            self._seen[run_id] = _Seen(heartbeat, beat_s, now_s)
        return now_s - beat_s


def with_clock(status: RunStatus) -> RunStatus:
    """The status of a run, with a warning where its heartbeat comes from the future."""
    ahead = status.heartbeat - datetime.now(UTC)
    if status.state not in ACTIVE or ahead <= MAX_AHEAD:
        return status
    text = f"its heartbeat is {ahead.total_seconds():.0f} s in the future: the clock of its machine, or the one here"
    return status.suffering("clock", f"{text}, is wrong")
