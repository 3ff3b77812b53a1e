"""Runs from their directories and, where there is one, from Redis.

| information | source |
|---|---|
| status | the newer one; Redis if both are about equally old, because it knows which machines are alive |
| metrics, goals | the run's directory; Redis if there is no directory on this machine |
| a request to stop | sent to both |

Where Redis has another run with the same id, one of the two is shown, the directory's unless only the other one is
active, and only this one is asked to stop.

If Redis is unavailable, everything in the directories can still be read, and each active run has a warning. Runs that
only Redis had are shown as they were last, and their metrics are unavailable; a run that nothing is known of may be
one of its own.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import TypeVar

from typing_extensions import override

from service.base.errors import DamagedStoreError, StoreError, StoreUnavailableError, UnknownRunError
from service.store.address import RedisAddress, address_from_environment
from service.store.disk_reader import DiskReader
from service.store.models import ACTIVE, Columns, GoalGrid, Record, RunReader, RunStatus

RETRY_AFTER_S = 5.0
"""Pause after Redis did not answer, so that requests do not wait for it."""
_ABOUT_EQUAL = timedelta(seconds=10)
_Answer = TypeVar("_Answer")
_logger = logging.getLogger(__name__)


def open_reader(runs_dir: Path, redis: RedisAddress | None = None) -> RunReader:
    """Make a reader of run directories and of ``redis``, or else of the Redis in ``TANDEM_REDIS_URL`` if that is set.

    Raises:
        StoreError: not a Redis URL, or the package redis is not installed.
    """
    address = redis or address_from_environment()
    if address is None:
        return DiskReader(runs_dir)
    from service.store.redis_reader import RedisReader  # needs the package redis

    return CombinedReader(DiskReader(runs_dir), RedisReader(address))


class CombinedReader(RunReader):
    """The runs of run directories and of a Redis; thread-safe. Nothing is read before the first call."""

    def __init__(self, disk: RunReader, redis: RunReader, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._disk, self._redis, self._clock = disk, redis, clock
        self._failure: tuple[float, str] | None = None
        """Time and reason of the last failure of Redis; None while it answers."""
        self._in_redis: dict[str, RunStatus] = {}
        """Its runs by their ids, when it answered last."""

    @override
    def runs(self) -> list[RunStatus]:
        on_disk = {run.run_id: run for run in self._disk.runs()}
        if (answer := self._ask_redis(self._redis.runs)) is not None:
            self._in_redis = {run.run_id: run for run in answer}
        away = self._failure is not None  # then what it had last is older than what is in directories
        in_redis = {run_id: run for run_id, run in self._in_redis.items() if not (away and run_id in on_disk)}
        merged = [self._merge(on_disk.get(run_id), in_redis.get(run_id)) for run_id in on_disk.keys() | in_redis.keys()]
        return sorted(merged, key=lambda run: (run.started, run.run_id), reverse=True)

    @override
    def run(self, run_id: str) -> RunStatus:
        try:
            on_disk = self._disk.run(run_id)
        except UnknownRunError:
            if (in_redis := self._ask_redis(lambda: self._redis.run(run_id))) is not None:
                return in_redis
            if self._failure is None:
                raise
            if run_id not in self._in_redis:
                raise self._away() from None
            return self._merge(None, self._in_redis[run_id])
        with suppress(DamagedStoreError):
            return self._merge(on_disk, self._ask_redis(lambda: self._redis.run(run_id)))
        return on_disk

    @override
    def metrics(self, run_id: str, *, after_iteration: int = 0, most: int | None = None) -> list[Record]:
        return self._disk_first(lambda reader: reader.metrics(run_id, after_iteration=after_iteration, most=most))

    @override
    def newest(self, run_id: str) -> Record | None:
        return self._disk_first(lambda reader: reader.newest(run_id))

    @override
    def columns(self, run_id: str, names: Sequence[str] | None) -> Columns:
        return self._disk_first(lambda reader: reader.columns(run_id, names))

    @override
    def sample(self, run_id: str, name: str, number: int) -> list[float | None]:
        return self._disk_first(lambda reader: reader.sample(run_id, name, number))

    @override
    def goals(self, run_id: str) -> GoalGrid | None:
        return self._disk_first(lambda reader: reader.goals(run_id))

    @override
    def request_stop(self, run_id: str) -> None:
        shown = self.run(run_id)  # or raise UnknownRunError
        in_redis = self._ask_redis(lambda: self._redis.run(run_id))
        if is_asked := in_redis is not None and not _are_two(shown, in_redis):
            self._ask_redis(lambda: self._redis.request_stop(run_id))
            is_asked = self._failure is None
        try:
            self._disk.request_stop(run_id)
        except UnknownRunError:  # of a run on another machine
            if self._failure is not None:
                raise self._away() from None
        except StoreError:
            if not is_asked:
                raise

    @override
    def directories(self) -> dict[str, Path]:
        return self._disk.directories()

    @override
    def directory(self, run_id: str) -> Path | None:
        return self._disk.directory(run_id)

    @override
    def ready(self) -> None:
        """Redis is not needed."""
        self._disk.ready()

    def _merge(self, on_disk: RunStatus | None, in_redis: RunStatus | None) -> RunStatus:
        if on_disk is None or in_redis is None:
            (newer,) = (run for run in (on_disk, in_redis) if run is not None)
        elif _are_two(on_disk, in_redis):
            newer = on_disk
            if in_redis.state in ACTIVE:
                both = f"two runs have the id {on_disk.run_id}, one in a directory here and one that reports to Redis: "
                if on_disk.state in ACTIVE:
                    text = "the second is not shown; give one of them another directory"
                else:
                    newer, text = in_redis, "curves and files shown here are those of the first; rename its directory"
                newer = newer.suffering("well", both + text)
        else:
            # Where no report comes, the directory's lock tells whether its process lives.
            in_front = in_redis.heartbeat > on_disk.heartbeat - _ABOUT_EQUAL and in_redis.condition != "silent"
            newer = in_redis if in_front else on_disk
        failure = self._failure
        if failure is None or newer.state not in ACTIVE:
            return newer
        warning = f"the status service reads no Redis: {failure[1]}"
        return newer.model_copy(update={"warnings": (*newer.warnings, warning)})

    def _disk_first(self, question: Callable[[RunReader], _Answer]) -> _Answer:
        try:
            return question(self._disk)
        except UnknownRunError:
            in_redis = self._ask_redis(lambda: (question(self._redis),))  # an answer may be None, too
            if in_redis is None and self._failure is not None:
                raise self._away() from None
            if in_redis is None:
                raise
            return in_redis[0]

    def _away(self) -> StoreUnavailableError:
        reason = "" if self._failure is None else self._failure[1]
        return StoreUnavailableError(f"no directory here has this run, and Redis is away: {reason}")

    def _ask_redis(self, question: Callable[[], _Answer]) -> _Answer | None:
        """Ask Redis; None if it does not know the run, or is unavailable."""
        failure = self._failure
        if failure is not None and self._clock() - failure[0] < RETRY_AFTER_S:
            return None
        answer = None
        try:
            with suppress(UnknownRunError):
                answer = question()
        except StoreUnavailableError as error:
            if failure is None:
                _logger.warning("%s; what is in run directories is shown all the same", error)
            self._failure = (self._clock(), str(error))
            return None
        if failure is not None:
            _logger.warning("Redis is back")
        self._failure = None
        return answer


def _are_two(one: RunStatus, other: RunStatus) -> bool:
    """Whether two reports under one id are of two runs; those of earlier versions do not tell."""
    return bool(one.identity and other.identity) and one.identity != other.identity
