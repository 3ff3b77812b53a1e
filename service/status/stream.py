"""Server-sent events of a run in progress; docs/api.md lists them.

FastAPI formats the events and sends a comment after 15 s without one. A browser that lost the connection reconnects by
itself and sends the id of its last record (``Last-Event-ID``); the stream continues after it.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Collection
from contextlib import asynccontextmanager

from anyio import to_thread
from fastapi.sse import ServerSentEvent

from service.base.errors import StoreError, StoreUnavailableError
from service.status.problems import ProblemError
from service.store.models import ACTIVE, RunReader, RunStatus

POLL_S = 0.5
MAX_STREAMS = 64
MAX_RECORDS = 1_000
"""Read in one poll, some 6 MB: a client that comes back after a night gets the others by later polls."""
MAX_AGE_S = 3600.0
"""Streams end after this time and browsers reconnect, so a client that silently disappeared is not served for ever."""
_RETRY_MS = 2000
EVENT_SCHEMA = {
    "properties": {
        "event": {"enum": ["metrics", "status", "reset", "unavailable", "end"]},
        "data": {"contentMediaType": "application/json"},
        "id": {"description": "the iteration; only metrics have one"},
    },
}
"""Additions to FastAPI's schema of an event."""


class RunFollower:
    """One client's position in one run; made by ``Streams.follow``."""

    def __init__(self, runs: RunReader, run: RunStatus, names: Collection[str] | None, after: int | None) -> None:
        self._runs, self._run_id = runs, run.run_id
        self._names = None if names is None else {*names, "iteration", "env_steps"}
        self._last_iteration = after
        """That the client has; None: it begins with the newest."""
        self._status: RunStatus | None = None
        self._unavailable = False
        self._has_more = False
        self.ended = False

    def poll(self) -> list[ServerSentEvent]:
        """Read the run and return the new events; store errors become events."""
        try:
            # the status first: if it says that the run has ended, no record may come after it
            status = self._runs.run(self._run_id)
            events = self._new_records()
        except StoreError as error:
            self.ended = not isinstance(error, StoreUnavailableError)  # deleted or damaged
            repeated, self._unavailable = self._unavailable and not self.ended, True
            return [] if repeated else [ServerSentEvent(event="unavailable", data={"detail": str(error)})]
        self._unavailable = False
        if status != self._status:
            self._status = status
            events.append(ServerSentEvent(event="status", data=status))
        if status.state not in ACTIVE and not self._has_more:
            self.ended = True
            events.append(ServerSentEvent(event="end", data=status))
        return events

    def _new_records(self) -> list[ServerSentEvent]:
        # also read the last record that was sent: it is gone if the run was resumed from an earlier iteration
        if self._last_iteration is None:
            self._last_iteration = max(0, self._newest_iteration() - 1)
        after = max(0, self._last_iteration - 1)
        records = self._runs.metrics(self._run_id, after_iteration=after, most=MAX_RECORDS)
        self._has_more = len(records) == MAX_RECORDS
        events = []
        if self._last_iteration and not records:
            self._last_iteration = self._newest_iteration()
            events.append(ServerSentEvent(event="reset", data={"after_iteration": self._last_iteration}))
        for record in records:
            iteration = int(record["iteration"] or 0)
            if iteration > self._last_iteration:
                self._last_iteration = iteration
                selected = {name: record[name] for name in record if self._names is None or name in self._names}
                events.append(ServerSentEvent(event="metrics", data=selected, id=str(iteration)))
        return events

    def _newest_iteration(self) -> int:
        newest = self._runs.newest(self._run_id)
        return int(newest["iteration"] or 0) if newest is not None else 0


class Streams:
    """All event streams of one service: counts them, limits their number, and ends them at shutdown."""

    def __init__(self, runs: RunReader) -> None:
        self._runs = runs
        self._closed = False
        self.num_open = 0
        """Places that are taken, from before a run is looked up until its stream has ended."""

    def close(self) -> None:
        """End all streams, within ``POLL_S``."""
        self._closed = True

    @asynccontextmanager
    async def follow(
        self, run_id: str, names: Collection[str] | None, after_iteration: int | None
    ) -> AsyncIterator[RunFollower]:
        """Follow a run after the last iteration that the client has; None to begin with the newest record.

        Raises:
            UnknownRunError: there is no such run.
            StoreUnavailableError: the runs cannot be read.
            ProblemError: too many streams are open.
        """
        if self.num_open >= MAX_STREAMS:
            raise ProblemError(
                503, "too-many-streams", f"{MAX_STREAMS} streams are open; close one, or ask for /metrics"
            )
        self.num_open += 1  # before anything is waited for, or many could pass at once
        try:
            run = await to_thread.run_sync(self._runs.run, run_id)
            yield RunFollower(self._runs, run, names, after_iteration)
        finally:
            self.num_open -= 1

    async def events(self, follower: RunFollower) -> AsyncIterator[ServerSentEvent]:
        """Yield events until the run ends, the stream is too old, or the service stops."""
        end_s = time.monotonic() + MAX_AGE_S
        yield ServerSentEvent(retry=_RETRY_MS)
        while not self._closed:
            for event in await to_thread.run_sync(follower.poll):
                yield event
            if follower.ended or time.monotonic() >= end_s:
                return
            await asyncio.sleep(POLL_S)
