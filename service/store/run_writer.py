"""Reports of a run to its directory and, where there is one, to Redis."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

from service.io.run_directory import RunDirectory
from service.store.address import RedisAddress
from service.store.disk import DiskWriter
from service.store.models import GoalGrid, Record, RunStatus, Trouble

if TYPE_CHECKING:
    from service.store.redis_writer import RedisWriter


class RunWriter:
    """The place a runner reports to. No method raises for a store that is away or full: training goes on.

    Args:
        directory: the run's; the caller has claimed it.
        run_id: id of the run.
        redis: a Redis to report to as well.

    Raises:
        RunTakenError: another driver runs this run; the directory is then as it was.
        StoreUnavailableError: Redis is not there, or does not let us in.
    """

    def __init__(self, directory: RunDirectory, run_id: str, redis: RedisAddress | None) -> None:
        remote: list[RedisWriter] = []
        if redis is not None:
            from service.store.redis_writer import RedisWriter  # where there is no Redis, its package is not needed

            remote.append(RedisWriter(redis, run_id))
        self._writers: list[DiskWriter | RedisWriter] = [DiskWriter(directory), *remote]

    def check(self) -> None:
        """Assert that this process is still the one that runs the run.

        Raises:
            RunTakenError: another one has taken it over; then nothing more may be written.
        """
        for writer in self._writers:
            writer.check()

    def status(self, status: RunStatus) -> None:
        """Replace what is known about the run."""
        for writer in self._writers:
            writer.status(status)

    def metrics(self, record: Record) -> None:
        """Append one iteration's metrics."""
        for writer in self._writers:
            writer.metrics(record)

    def goals(self, grid: GoalGrid) -> None:
        """Replace the grid."""
        for writer in self._writers:
            writer.goals(grid)

    def stop_requested(self) -> bool:
        """Whether somebody asked the run to stop anywhere since it was started."""
        return any(writer.stop_requested() for writer in self._writers)

    def troubles(self) -> list[Trouble]:
        """Problems at the moment; empty when all is well."""
        return [trouble for writer in self._writers for trouble in writer.troubles()]

    def close(self) -> None:
        """Write what still waits, for a bounded time, to every store, also where another fails."""
        with ExitStack() as stack:
            for writer in reversed(self._writers):
                stack.callback(writer.close)
