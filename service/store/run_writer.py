"""Reports of a run to its directory and, where there is one, to Redis."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from pydantic import BaseModel

from service.base.files import os_errors, write_atomic
from service.store.address import RedisAddress
from service.store.models import (
    GRID_FILE,
    STATUS_FILE,
    STOP_FILE,
    Condition,
    GoalGrid,
    Record,
    RunState,
    RunStatus,
    Trouble,
)
from service.store.run_directory import RunDirectory

if TYPE_CHECKING:
    from service.store.redis_writer import RedisWriter

STATUS_INTERVAL_S = 1.0
_logger = logging.getLogger(__name__)


def reporting_to(
    directory: RunDirectory, run_id: str, address: RedisAddress | None, *, resumed: bool = False
) -> RunWriter:
    """The writer of a run to its directory, which the caller has claimed, and to the Redis that is given.

    Raises:
        RunTakenError: see ``RedisWriter``; the directory is then as it was.
        StoreUnavailableError: of a new run, Redis is not there, or does not let us in.
    """
    if address is None:
        return RunWriter(directory)
    from service.store.redis_writer import RedisWriter  # where there is no Redis, its package is not needed

    run, epoch = directory.history.run, directory.epoch
    return RunWriter(directory, RedisWriter(address, run_id, run=run, epoch=epoch, resumed=resumed))


class RunWriter:
    """The place a runner reports to. No method raises for a store that is away or full: training goes on.

    A few small files a second are written without waiting for the disk, so the training thread does it by the way.
    Metrics go to Redis alone: the run directory has its own ``metrics.jsonl``.

    Args:
        directory: the run's; the caller has claimed it.
        redis: a Redis to report to as well; ``close`` closes it.
        clock: counts seconds.
    """

    def __init__(
        self,
        directory: RunDirectory,
        redis: RedisWriter | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Take back the stop request of an earlier process.

        Raises:
            StorageError: it cannot be deleted; the run would stop at once.
        """
        self._directory, self._redis = directory, redis
        self._stop_file = directory.path / STOP_FILE
        self._clock = clock
        self._waiting: dict[str, BaseModel] = {}
        """Newest status and grid by the names of their files, where these are older."""
        self._written_s = float("-inf")
        self._told: tuple[RunState, Condition] | None = None
        with os_errors("write", self._stop_file):
            self._stop_file.unlink(missing_ok=True)

    def status(self, status: RunStatus) -> None:
        """Replace what is known about the run."""
        told, now_s = (status.state, status.condition), self._clock()
        self._waiting[STATUS_FILE] = status
        if told != self._told or now_s - self._written_s >= STATUS_INTERVAL_S:
            self._told, self._written_s = told, now_s
            self._write()
        if self._redis is not None:
            self._redis.status(status)

    def metrics(self, record: Record) -> None:
        """Append one iteration's metrics."""
        if self._redis is not None:
            self._redis.metrics(record)

    def goals(self, grid: GoalGrid) -> None:
        """Replace the grid; its file is written with the next status."""
        self._waiting[GRID_FILE] = grid
        if self._redis is not None:
            self._redis.goals(grid)

    def stop_requested(self) -> bool:
        """Whether the run was asked to stop anywhere since it was started."""
        # no exists() of Path: it raises where the directory may not be read
        return os.path.exists(self._stop_file) or (self._redis is not None and self._redis.stop_requested())

    def troubles(self) -> list[Trouble]:
        """Problems at the moment, such as files that cannot be written; empty when all is well."""
        found = [Trouble("disk", problem) for problem in self._directory.problems()]
        return [*found, *(self._redis.troubles() if self._redis is not None else ())]

    def close(self) -> None:
        """Write what still waits, for a bounded time."""
        self._write()
        if self._redis is not None:
            self._redis.close()

    def _write(self) -> None:
        for name, content in list(self._waiting.items()):
            path = self._directory.path / name
            with self._directory.keep_running(path):
                write_atomic(path, content.model_dump_json().encode() + b"\n", flush=False)
                if self._waiting.get(name) is content:  # a thread beside this one may have left a newer one
                    del self._waiting[name]
