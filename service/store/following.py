"""Waiting for what a run records next, for pages that show it live."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator

from service.store.models import ACTIVE, Record, RunReader

POLL_S = 0.5
"""A poll costs a reader well under a millisecond where there is nothing new."""
QUIET_S = 15.0


async def follow(
    reader: RunReader, run_id: str, *, after_iteration: int = 0, poll_s: float = POLL_S, quiet_s: float = QUIET_S
) -> AsyncIterator[list[Record]]:
    """The records of iterations above ``after_iteration`` as they come, until the run has ended.

    The reader is asked in a thread, so other tasks go on. A run that is resumed at an earlier iteration shows again
    where it is further than before.

    Args:
        reader: of the run.
        run_id: of the run.
        after_iteration: the last that is known.
        poll_s: between two looks.
        quiet_s: after so long without news an empty list comes: a sign of life.

    Yields:
        New records in order; at least one, except as a sign of life.

    Raises:
        UnknownRunError: there is no such run.
        StoreUnavailableError: the store is away; follow again from the last iteration that came.
    """
    spoke_s = time.monotonic()
    while True:
        ended = (await asyncio.to_thread(reader.run, run_id)).state not in ACTIVE
        records = await asyncio.to_thread(reader.metrics, run_id, after_iteration=after_iteration)
        if records or time.monotonic() - spoke_s >= quiet_s:
            spoke_s = time.monotonic()
            after_iteration = int(records[-1]["iteration"] or 0) if records else after_iteration
            yield records
        if ended:  # asked before the records were, so these were the last
            return
        await asyncio.sleep(poll_s)
