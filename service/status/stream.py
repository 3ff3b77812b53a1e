"""A run while it goes on, as server-sent events.

| event | data | when |
|---|---|---|
| ``metrics`` | one record: ``iteration``, ``env_steps``, the metrics; its id is the iteration | an iteration is done |
| ``status`` | ``RunStatus`` | at the beginning, and when it changed |
| ``reset`` | ``{"after_iteration": N}``: forget later ones, they are made anew | the run was resumed from before |
| ``unavailable`` | ``{"detail": "..."}`` | the store is away; it is asked again |
| ``end`` | ``RunStatus`` | the run has ended: the last event |

Between events a comment is sent at least every ``KEEP_ALIVE_S``. A browser that lost the connection comes back by
itself and says the id of the last record it has (``Last-Event-ID``), after which the stream goes on.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Collection
from typing import Any

from anyio import to_thread

from service.status.problems import ProblemError
from service.store.errors import StoreError, StoreUnavailableError
from service.store.models import ACTIVE, Record, RunReader, RunStatus

KEEP_ALIVE_S = 15.0
POLL_S = 0.5
MAX_STREAMS = 64
MAX_AGE_S = 3600.0
"""A stream ends then, and its browser comes back: one that is gone without a word does not stay for ever."""
_RETRY_MS = 2000
EVENT_SCHEMA = {
    "type": "object",
    "description": "one event",
    "properties": {
        "event": {"enum": ["metrics", "status", "reset", "unavailable", "end"]},
        "data": {"type": "string", "contentMediaType": "application/json"},
        "id": {"type": "string", "description": "the iteration, of metrics only"},
        "retry": {"type": "integer", "description": "milliseconds, once at the beginning"},
    },
}
"""Of the OpenAPI document."""


class Streams:
    """All streams of one service, so that they can be counted, bounded, and ended when it ends."""

    def __init__(self, runs: RunReader, *, max_age_s: float = MAX_AGE_S) -> None:
        """``max_age_s``: how long one may last."""
        self._runs, self._max_age_s = runs, max_age_s
        self._closing = asyncio.Event()
        self.num_open = 0

    def close(self) -> None:
        """End them all; to be called in the event loop they run in."""
        self._closing.set()

    async def open(
        self, run_id: str, names: Collection[str] | None, after_iteration: int | None
    ) -> AsyncIterator[bytes]:
        """The events of a run after an iteration; None for the newest record and those to come.

        Raises:
            UnknownRunError: there is no such run.
            StoreUnavailableError: the runs cannot be read.
            ProblemError: too many streams are open.
        """
        if self.num_open >= MAX_STREAMS:
            raise ProblemError(
                503, "too-many-streams", f"{MAX_STREAMS} streams are open; close one, or ask for /metrics"
            )
        run = await to_thread.run_sync(self._runs.run, run_id)
        follower = _Follower(self._runs, run, names, after_iteration)
        first = await to_thread.run_sync(follower.poll)
        return self._events(follower, first)

    async def _events(self, follower: _Follower, events: list[bytes]) -> AsyncIterator[bytes]:
        self.num_open += 1
        try:
            yield f"retry: {_RETRY_MS}\n\n".encode()
            end_s = time.monotonic() + self._max_age_s
            spoke_s = time.monotonic()
            while True:
                for event in events:
                    yield event
                if events:
                    spoke_s = time.monotonic()
                elif time.monotonic() - spoke_s > KEEP_ALIVE_S:
                    yield b": nothing new\n\n"
                    spoke_s = time.monotonic()
                if follower.ended or time.monotonic() >= end_s or await self._closed_within(POLL_S):
                    return
                events = await to_thread.run_sync(follower.poll)
        finally:
            self.num_open -= 1

    async def _closed_within(self, seconds: float) -> bool:
        try:
            await asyncio.wait_for(self._closing.wait(), seconds)
        except TimeoutError:
            return False
        return True


class _Follower:
    """What one listener has heard of one run."""

    def __init__(self, runs: RunReader, run: RunStatus, names: Collection[str] | None, after: int | None) -> None:
        self._runs, self._run_id = runs, run.run_id
        self._names = None if names is None else {*names, "iteration", "env_steps"}
        self._heard = max(0, run.iteration - 1) if after is None else after
        self._status: RunStatus | None = None
        self._away = False
        self.ended = False

    def poll(self) -> list[bytes]:
        """What is new, as events."""
        try:
            # the status first: records that come in between must not be missing when it says that the run has ended
            status = self._runs.run(self._run_id)
            events = self._new_records()
        except StoreUnavailableError as error:
            events = [] if self._away else [_event("unavailable", json.dumps({"detail": str(error)}))]
            self._away = True
            return events
        except StoreError as error:  # deleted, or damaged
            self.ended = True
            return [_event("unavailable", json.dumps({"detail": str(error)}))]
        self._away = False
        if status != self._status:
            self._status = status
            events.append(_event("status", status.model_dump_json()))
        if status.state not in ACTIVE:
            self.ended = True
            events.append(_event("end", status.model_dump_json()))
        return events

    def _new_records(self) -> list[bytes]:
        # the last record heard of is read again, for it is gone when the run was resumed from before it
        records = self._runs.metrics(self._run_id, after_iteration=max(0, self._heard - 1))
        events = []
        if self._heard and not records:
            there = self._runs.metrics(self._run_id)
            self._heard = int(there[-1]["iteration"] or 0) if there else 0
            events.append(_event("reset", json.dumps({"after_iteration": self._heard})))
        for record in records:
            iteration = int(record["iteration"] or 0)
            if iteration > self._heard:
                self._heard = iteration
                events.append(_event("metrics", json.dumps(self._chosen(record)), identity=iteration))
        return events

    def _chosen(self, record: Record) -> dict[str, Any]:
        if self._names is None:
            return record
        return {name: value for name, value in record.items() if name in self._names}


def _event(kind: str, data: str, *, identity: int | None = None) -> bytes:
    """One event; ``data`` is JSON and so has no line ends."""
    head = f"id: {identity}\n" if identity is not None else ""
    return f"{head}event: {kind}\ndata: {data}\n\n".encode()
