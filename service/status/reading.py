"""Runs from their directories and from Redis: directories are the truth, Redis knows runs that are elsewhere, too.

| what | comes from |
|---|---|
| whether and how a run goes | where it was told later; of equals Redis, which knows across machines who lives |
| metrics | the run's directory, which has all of them; Redis where it has none here |
| goals | where the grid is newer |
| a request to stop | goes to both |

While Redis is away all that is in directories is there as before, each active run with a warning.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import TypeVar

from service.store.address import RedisAddress, address_from_environment
from service.store.disk_reader import DiskReader
from service.store.errors import StoreUnavailableError, UnknownRunError
from service.store.models import ACTIVE, GoalGrid, Record, RunReader, RunStatus

LEAVE_ALONE_S = 5.0
"""After it did not answer: nobody who asks for a run waits for a Redis that is away."""
_ABOUT_EQUAL = timedelta(seconds=10)
_Answer = TypeVar("_Answer")
_logger = logging.getLogger(__name__)


def open_reader(runs_dir: Path, redis: RedisAddress | None = None) -> RunReader:
    """A reader of the runs in a directory and, where there is one, of those in a Redis.

    Args:
        runs_dir: directory of run directories.
        redis: None for the one of ``TANDEM_REDIS_URL``, if that is set.

    Raises:
        StoreError: not a Redis URL, or the package redis is not installed.
    """
    address = redis or address_from_environment()
    if address is None:
        return DiskReader(runs_dir)
    from service.store.redis_reader import RedisReader  # its package is for those who have a Redis

    return BothReader(DiskReader(runs_dir), RedisReader(address))


class BothReader:
    """The ``RunReader`` of run directories and a Redis; any number of threads may use it at once."""

    def __init__(self, disk: RunReader, redis: RunReader, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Nothing is read before the first call; ``clock`` counts seconds."""
        self._disk, self._redis, self._clock = disk, redis, clock
        self._away: tuple[float, str] | None = None

    def runs(self) -> list[RunStatus]:
        """All runs, newest start first."""
        here = {run.run_id: run for run in self._disk.runs()}
        told = {run.run_id: run for run in self._ask(self._redis.runs) or ()}
        merged = [self._merge(here.get(run_id), told.get(run_id)) for run_id in here.keys() | told.keys()]
        return sorted(merged, key=lambda run: (run.started, run.run_id), reverse=True)

    def run(self, run_id: str) -> RunStatus:
        """One run."""
        told = self._ask(lambda: self._redis.run(run_id))
        try:
            return self._merge(self._disk.run(run_id), told)
        except UnknownRunError:
            if told is None:
                raise
            return told

    def metrics(self, run_id: str, *, after_iteration: int = 0) -> list[Record]:
        """The records of iterations above ``after_iteration``, in order."""
        try:
            return self._disk.metrics(run_id, after_iteration=after_iteration)
        except UnknownRunError:
            told = self._ask(lambda: self._redis.metrics(run_id, after_iteration=after_iteration))
            if told is None:
                raise
            return told

    def goals(self, run_id: str) -> GoalGrid | None:
        """The newest grid; None before the first."""
        self.run(run_id)  # or unknown
        grids = (_known(lambda: self._disk.goals(run_id)), self._ask(lambda: self._redis.goals(run_id)))
        return max((grid for grid in grids if grid is not None), key=lambda grid: grid.iteration, default=None)

    def request_stop(self, run_id: str) -> None:
        """Ask a run to end after its current iteration; nothing happens if it has ended."""
        self.run(run_id)  # or unknown
        told = self._ask(lambda: self._stop_in_redis(run_id))
        try:
            self._disk.request_stop(run_id)
        except UnknownRunError:
            if told is None:
                raise

    def _stop_in_redis(self, run_id: str) -> bool:
        self._redis.request_stop(run_id)
        return True

    def ready(self) -> None:
        """Return if the directories can be read; without Redis there is less to see, but nothing to wait for."""
        self._disk.ready()

    def _merge(self, here: RunStatus | None, told: RunStatus | None) -> RunStatus:
        if here is None or told is None:
            (known,) = (run for run in (here, told) if run is not None)
        else:
            known = told if told.heartbeat > here.heartbeat - _ABOUT_EQUAL else here
        away = self._away
        if away is None or known.state not in ACTIVE:
            return known
        return known.model_copy(update={"warnings": (*known.warnings, f"the status service reads no Redis: {away[1]}")})

    def _ask(self, question: Callable[[], _Answer]) -> _Answer | None:
        """What Redis answers; None where it does not know the run, or is away."""
        away = self._away
        if away is not None and self._clock() - away[0] < LEAVE_ALONE_S:
            return None
        try:
            answer = _known(question)
        except StoreUnavailableError as error:
            if away is None:
                _logger.warning("%s; what is in run directories is shown all the same", error)
            self._away = (self._clock(), str(error))
            return None
        if away is not None:
            _logger.warning("Redis is back")
        self._away = None
        return answer


def _known(question: Callable[[], _Answer]) -> _Answer | None:
    try:
        return question()
    except UnknownRunError:
        return None
