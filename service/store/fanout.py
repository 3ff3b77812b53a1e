"""Reports to several places at once."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from service.store.address import RedisAddress
from service.store.disk import DiskWriter
from service.store.models import GoalGrid, Record, RunStatus, RunWriter


class FanoutWriter:
    """A ``RunWriter`` that hands everything to several others, in their order."""

    def __init__(self, writers: Sequence[RunWriter]) -> None:
        """Take ``writers``, which it closes with itself."""
        self._writers = tuple(writers)

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

    def warnings(self) -> list[str]:
        """Problems of all of them at the moment."""
        return [warning for writer in self._writers for warning in writer.warnings()]

    def close(self) -> None:
        """Close all, also where one of them fails."""
        with ExitStack() as stack:
            for writer in reversed(self._writers):
                stack.callback(writer.close)


def open_writer(directory: Path, run_id: str, redis: RedisAddress | None) -> FanoutWriter:
    """A writer to a run's directory, whose lock the caller has, and to Redis where there is one.

    Raises:
        RunTakenError: another driver runs this run.
        StoreUnavailableError: Redis is not there, or does not let us in.
    """
    if redis is None:
        return FanoutWriter([DiskWriter(directory)])
    from service.store.redis_writer import RedisWriter  # where there is no Redis, its package is not needed

    remote = RedisWriter(redis, run_id)
    return FanoutWriter([DiskWriter(directory), remote])
