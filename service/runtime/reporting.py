"""Reporting of a run while it goes on: its status, its metrics, its goal grid."""

from __future__ import annotations

import time
from collections.abc import Mapping
from datetime import UTC, datetime
from types import TracebackType
from typing import Any, Literal, Self

from service.config import Config
from service.runtime.runner import Runner
from service.store.disk import GOALS_INTERVAL_S
from service.store.models import RunState, RunStatus
from service.store.run_writer import RunWriter


class Report:
    """Consumes the metrics of every iteration and produces statuses and goal grids; waits for nothing.

    A context manager: where its block ends with an exception, the run has failed or was interrupted, and in any case
    the writer is closed.

    Args:
        config: the run.
        run_id: of the run.
        runtime: which runner runs it.
        writer: to whom it is told.
        published: what the run published before.
    """

    def __init__(
        self,
        config: Config,
        run_id: str,
        runtime: Literal["local", "ray"],
        writer: RunWriter,
        *,
        published: str | None = None,
    ) -> None:
        self._writer = writer
        self._gridded_s = float("-inf")
        now = datetime.now(UTC)
        self._status = RunStatus(
            run_id=run_id,
            name=config.name,
            runtime=runtime,
            state="starting",
            started=now,
            heartbeat=now,
            total_env_steps=config.run.total_env_steps,
            published=published,
        )

    def __enter__(self) -> Self:
        self._tell()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if isinstance(error, Exception):
                self.end("failed", error=" ".join(f"{type(error).__name__}: {error}".split()))
            elif error is not None:  # a signal's
                self.end("interrupted", error=f"ended at once by {error}" if str(error) else None)
        finally:
            self._writer.close()

    def begin(self, runner: Runner) -> None:
        """Say that the run begins, or goes on where it was."""
        self._status = self._status.model_copy(update={"state": "running"})
        self.beat(runner)

    def iteration(self, runner: Runner, metrics: Mapping[str, float]) -> None:
        """Tell an iteration's metrics, where the run is, and now and then what the generator knows."""
        self._writer.metrics(dict(metrics))
        if time.monotonic() - self._gridded_s >= GOALS_INTERVAL_S:
            self._gridded_s = time.monotonic()
            self._writer.goals(runner.grid())
        self._status = self._status.model_copy(
            update={
                "env_steps_per_s": metrics["time/env_steps_per_s"],
                "policy_version": int(metrics.get("learner/version", self._status.policy_version)),
                "policy_lag": metrics.get("learner/policy_lag", 0.0),
            }
        )
        self.beat(runner)

    def beat(self, runner: Runner) -> None:
        """Tell that the run is alive, how far it is, and how its parts are."""
        health = runner.health()
        self._tell(
            iteration=runner.iteration,
            num_env_steps=runner.num_env_steps,
            num_rollouts_counted=health.num_rollouts_counted,
            num_rollouts_refused=health.num_rollouts_refused,
            stopping=self.stop_requested(),
            actors=health.actors,
            last_error=health.last_error,
            warnings=health.warnings,
        )

    def stop_requested(self) -> bool:
        """Whether somebody asked the run to stop."""
        return self._writer.stop_requested()

    def end(self, state: RunState, *, published: str | None = None, error: str | None = None) -> None:
        """Say how the run ended."""
        published = published or self._status.published
        self._tell(state=state, stopping=False, published=published, last_error=error or self._status.last_error)

    def _tell(self, **changes: Any) -> None:
        warnings = (*self._writer.warnings(), *changes.pop("warnings", ()))
        changes |= {"heartbeat": datetime.now(UTC), "warnings": warnings}
        self._status = self._status.model_copy(update=changes)
        self._writer.status(self._status)
