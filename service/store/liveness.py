"""Runs whose process is gone without a word, killed or cut off from power: they must not seem to run for ever."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from service.store.models import ACTIVE, RunStatus

SILENT_AFTER = timedelta(seconds=60)
"""A run that was silent for so long is asked after."""


def is_silent(status: RunStatus, now: datetime | None = None) -> bool:
    """Whether a run that has not ended was not heard of for ``SILENT_AFTER``."""
    return status.state in ACTIVE and (now or datetime.now(UTC)) - status.heartbeat > SILENT_AFTER


def vanished(status: RunStatus) -> RunStatus:
    """The status of a silent run that nobody runs any more."""
    when = status.heartbeat.astimezone(UTC).isoformat(timespec="seconds")
    error = f"its process vanished without a word, last heard of at {when}; --resume goes on from its last checkpoint"
    return status.model_copy(update={"state": "interrupted", "stopping": False, "last_error": error})
