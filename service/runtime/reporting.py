"""What a run of one process tells about itself while it goes on, to whoever shows it."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from types import TracebackType
from typing import Any, Self

from service.config import Config
from service.generator.generator import TaskGenerator
from service.runtime.telling import goal_grid
from service.store.disk import GOALS_INTERVAL_S
from service.store.models import ActorStatus, RunState, RunStatus, RunWriter


class LocalReport:
    """Consumes the metrics of every iteration and produces statuses and goal grids; waits for nothing.

    A context manager: where its block ends with an exception, the run has failed or was interrupted, and in any case
    the writer is closed.

    Args:
        config: the run.
        run_id: of the run.
        writer: to whom it is told.
        published: what the run published before.
    """

    def __init__(self, config: Config, run_id: str, writer: RunWriter, *, published: str | None = None) -> None:
        self._writer = writer
        self._gridded_s = float("-inf")
        now = datetime.now(UTC)
        self._status = RunStatus(
            run_id=run_id,
            name=config.name,
            runtime="local",
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

    def begin(self, iteration: int, num_env_steps: int) -> None:
        """Say that the run goes on after that many iterations and env steps."""
        self._tell(state="running", iteration=iteration, num_env_steps=num_env_steps)

    def iteration(self, metrics: Mapping[str, float], generator: TaskGenerator) -> None:
        """Tell an iteration's metrics, where the run is, and now and then what the generator knows."""
        iteration, num_env_steps = int(metrics["iteration"]), int(metrics["env_steps"])
        self._writer.metrics(dict(metrics))
        if time.monotonic() - self._gridded_s >= GOALS_INTERVAL_S:
            self._gridded_s = time.monotonic()
            self._writer.goals(goal_grid(generator, iteration, num_env_steps))
        num_rollouts = iteration - 1  # the newest one is learned from during the next iteration
        actor = ActorStatus(
            name="rollout-0",
            incarnation=0,
            state="alive",
            pid=os.getpid(),
            heartbeat=datetime.now(UTC),
            num_rollouts=iteration,
            num_env_steps=num_env_steps,
        )
        self._tell(
            iteration=iteration,
            num_env_steps=num_env_steps,
            env_steps_per_s=metrics["time/env_steps_per_s"],
            policy_version=int(metrics.get("learner/version", self._status.policy_version)),
            policy_lag=metrics.get("learner/policy_lag", 0.0),
            num_rollouts_counted=num_rollouts,
            stopping=self.stop_requested(),
            actors=(actor,),
        )

    def stop_requested(self) -> bool:
        """Whether somebody asked the run to stop."""
        return self._writer.stop_requested()

    def end(self, state: RunState, *, published: str | None = None, error: str | None = None) -> None:
        """Say how the run ended."""
        self._tell(state=state, stopping=False, published=published or self._status.published, last_error=error)

    def _tell(self, **changes: Any) -> None:
        changes |= {"heartbeat": datetime.now(UTC), "warnings": tuple(self._writer.warnings())}
        self._status = self._status.model_copy(update=changes)
        self._writer.status(self._status)
