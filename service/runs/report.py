"""Reporting of a run while it goes on: its status, its metrics, its goal grid."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from threading import Event, Lock, Thread
from types import TracebackType
from typing import Any, Literal, Self

from service.base.errors import RunTakenError
from service.base.jsonl import plain
from service.base.liveness import work_done
from service.config import Config
from service.config.task import TaskConfig
from service.methods.method import Health
from service.runs.run import Run
from service.store.models import CONDITIONS, RunState, RunStatus, RunTotals, Trial
from service.store.run_directory import RunDirectory
from service.store.run_writer import RunWriter

BEAT_S = 2.0
"""Time between two heartbeats of the thread that sends them."""
GOALS_INTERVAL_S = 5.0
"""Time between two grids of goals."""
_MEASURED = {
    "success": "last",
    "success_low": "last_low",
    "success_high": "last_high",
    "success_ever": "ever",
}
"""Results of a task in its status, by the ends of their metrics' names."""


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
        previous: the last status of an earlier process, whose totals go on. How far that came, and what a task has
            come to, stays until the run goes on: it may be refused.
        identity: of the run, by which runs of the same id are told apart.
        epoch: number of this process among those that ever ran the run.
        options: of the command that goes on with it.
    """

    def __init__(
        self,
        config: Config,
        run_id: str,
        runtime: Literal["local", "ray"],
        writer: RunWriter,
        *,
        published: str | None = None,
        previous: RunStatus | None = None,
        identity: str = "",
        epoch: int = 0,
        options: Sequence[str] = (),
    ) -> None:
        self._writer, self._lock = writer, Lock()
        self._totals = previous.totals.model_dump() if previous is not None else {}
        self._counted: dict[str, int] = {}
        self._warnings: tuple[str, ...] = ()
        """Of the run's method."""
        self._gridded_s = float("-inf")
        now, trial = datetime.now(UTC), None
        if isinstance(config, TaskConfig):
            digest = config.primitives_digest
            trial = Trial(
                task=config.task,
                method=config.method,
                seed=config.seed,
                primitives=config.primitives if digest is not None else None,
                primitives_digest=digest,
            )
        self._trial = trial
        self._status = RunStatus(
            run_id=run_id,
            name=config.name,
            runtime=runtime,
            state="starting",
            started=now,
            heartbeat=now,
            identity=identity,
            epoch=epoch,
            total_env_steps=config.run.total_env_steps,
            options=tuple(options),
            trial=trial,
            published=published,
        )
        if previous is not None:
            kept = {key: getattr(previous, key) for key in ("totals", "iteration", "num_env_steps", "trial")}
            self._status = self._status.model_copy(update=kept)

    def __enter__(self) -> Self:
        self._tell()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if isinstance(error, RunTakenError):
                pass  # the status is another's now
            elif isinstance(error, Exception):
                self.end("failed", error=" ".join(f"{type(error).__name__}: {error}".split()))
            elif error is not None:  # a signal's
                self.end("interrupted", error=f"ended at once by {error}" if str(error) else None)
        finally:
            self._writer.close()

    @contextmanager
    def beating(self, directory: RunDirectory) -> Iterator[None]:
        """Tell in a block, whatever it waits for, that the run is alive while its work goes on (``liveness``)."""
        over = Event()

        def beat() -> None:
            done = work_done()
            with suppress(RunTakenError):  # the block finds that out, too
                while not over.wait(BEAT_S):
                    if (now := work_done()) != done:
                        done = now
                        directory.check_owner()
                        self.alive()

        thread = Thread(target=beat, name="heartbeat", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def begin(self, run: Run) -> None:
        """Say that the run begins, or goes on where it was."""
        self._status = self._status.model_copy(update={"state": "running", "trial": self._trial})
        self._counted = self._counters(run, run.method.health())  # where it goes on is no work of this process
        if not self._totals:  # of earlier ones nothing is known but how far they came
            self._totals = {name: self._counted[name] for name in ("iterations", "env_steps")}
        self.beat(run)

    def iteration(self, run: Run, metrics: Mapping[str, float]) -> None:
        """Tell an iteration's metrics, where the run is, and now and then what the generator knows; see ``beat``."""
        run.directory.check_owner()
        self._writer.metrics(dict(metrics))
        if time.monotonic() - self._gridded_s >= GOALS_INTERVAL_S:
            self._gridded_s = time.monotonic()
            if (grid := run.method.grid()) is not None:
                self._writer.goals(grid)
        # those of a method of a user's may be NaN
        version, lag = (plain(metrics.get(name)) for name in ("learner/version", "learner/policy_lag"))
        self.beat(
            run,
            env_steps_per_s=metrics["time/env_steps_per_s"],
            policy_version=self._status.policy_version if version is None else int(version),
            policy_lag=lag or 0.0,
        )

    def beat(self, run: Run, **changes: Any) -> None:
        """Tell that the run is alive, how far it is, and how its parts are; stop it where that was asked for.

        Args:
            run: it.
            changes: of its status, beside these.

        Raises:
            RunTakenError: another process has taken it over.
        """
        run.directory.check_owner()
        health = run.method.health()
        counters = self._counters(run, health)
        for name, value in counters.items():
            self._totals[name] = self._totals.get(name, 0) + max(0, value - self._counted.get(name, 0))
        self._counted = counters
        stopping = self._writer.stop_requested()
        if stopping:
            run.request_stop()
        self._tell(
            totals=RunTotals(**self._totals),
            iteration=run.iteration,
            num_env_steps=run.num_env_steps,
            num_rollouts_counted=health.num_rollouts_counted,
            num_rollouts_refused=health.num_rollouts_refused,
            stopping=stopping,
            actors=health.actors,
            last_error=health.last_error,
            warnings=health.warnings,
            **changes,
        )

    def alive(self) -> None:
        """Tell that the process of the run lives, of which nothing else is new."""
        self._tell()

    def measured(self, metrics: Mapping[str, float]) -> None:
        """Tell how well the run does in the end; of a task that is shown beside its name."""
        trial = self._status.trial
        if trial is not None:
            found = {name: metrics.get(f"evaluation/success_{place}") for name, place in _MEASURED.items()}
            num_episodes = int(metrics.get("evaluation/num_episodes", 0)) or None
            self._tell(trial=trial.model_copy(update={**found, "num_episodes": num_episodes}))

    def end(self, state: RunState, *, published: str | None = None, error: str | None = None) -> None:
        """Say how the run ended."""
        published = published or self._status.published
        self._tell(state=state, stopping=False, published=published, last_error=error or self._status.last_error)

    @staticmethod
    def _counters(run: Run, health: Health) -> dict[str, int]:
        """What this process counts now; it falls where the run goes back to a checkpoint."""
        return {
            "iterations": run.iteration,
            "env_steps": run.num_env_steps,
            "rollouts_counted": health.num_rollouts_counted,
            "rollouts_refused": health.num_rollouts_refused,
            "replacements": sum(actor.num_replaced for actor in health.actors),
        }

    def _tell(self, **changes: Any) -> None:
        with self._lock:  # ``beating`` has a thread of its own
            troubles = self._writer.troubles()
            condition = max((each.condition for each in troubles), key=CONDITIONS.index, default="well")
            self._warnings = changes.pop("warnings", self._warnings)
            warnings = (*(each.text for each in troubles), *self._warnings)
            changes |= {"heartbeat": datetime.now(UTC), "condition": condition, "warnings": warnings}
            self._status = self._status.model_copy(update=changes)
            self._writer.status(self._status)
