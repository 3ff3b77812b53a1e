"""The interface of the two runners, and the part of an iteration that is the same in both."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from service.config import Config
from service.errors import TandemError
from service.generator.bins import GoalCells
from service.io.run_directory import RunDirectory
from service.policies.parameters import Parameters
from service.runtime.bookkeeping import Bookkeeper
from service.runtime.timing import Timing
from service.runtime.workers import GeneratorResult, RoundSummary, UpdateResult
from service.store.models import ActorStatus, GoalCell, GoalGrid
from service.types import IntArray, Metrics, StateArray

OnIteration = Callable[[Metrics], None]
OnBeat = Callable[[], None]


class ClusterError(TandemError):
    """The cluster does not let the run go on; what it had learned is saved."""

    exit_code = 1


class StateLostError(ClusterError):
    """A state was lost with the machine that kept it; the newest checkpoint has one."""

    def __init__(self, lost: str) -> None:
        """Say what was lost, and how the run goes on."""
        super().__init__(f"{lost}; the run goes back to its newest checkpoint")


@dataclass(frozen=True, slots=True)
class RunResult:
    """Reason and length of a run that has ended."""

    reason: str
    """``finished`` (budget), ``converged`` (the paper's stop criterion) or ``interrupted``."""
    iteration: int
    num_env_steps: int


@dataclass(frozen=True, slots=True)
class Health:
    """The state of a runner's workers."""

    actors: tuple[ActorStatus, ...]
    num_rollouts_counted: int
    """Learned from, by the processes that run now."""
    num_rollouts_refused: int = 0
    warnings: tuple[str, ...] = ()
    last_error: str | None = None


@dataclass(frozen=True, slots=True)
class IterationResult:
    """Results of all workers for one iteration."""

    rounds: Sequence[RoundSummary]
    recorded: GeneratorResult
    updated: UpdateResult | None
    """None where there was nothing to learn from yet."""
    num_actors_alive: int
    hand_over_s: float = 0.0
    """Mean time a round's result was on its way or in line, seconds."""

    @property
    def num_env_steps(self) -> int:
        """Steps of both players."""
        return sum(each.num_env_steps for each in self.rounds)


class Runner(ABC):
    """A pre-training run that can be started, watched and stopped.

    Args:
        config: the run.
        directory: where it keeps everything.
    """

    def __init__(self, config: Config, directory: RunDirectory) -> None:
        self.config, self.directory = config, directory
        self.bookkeeper = Bookkeeper(config, directory)
        self.timing = Timing()
        self._stop_requested = self._converged = False
        self._on_iteration: OnIteration = lambda metrics: None

    @property
    def iteration(self) -> int:
        """Finished iterations."""
        return self.bookkeeper.iteration

    @property
    def num_env_steps(self) -> int:
        """Env steps of both players."""
        return self.bookkeeper.num_env_steps

    def request_stop(self) -> None:
        """End soon, with a checkpoint. Safe to call from a signal handler."""
        self._stop_requested = True

    def run(self, on_iteration: OnIteration = lambda metrics: None, on_beat: OnBeat = lambda: None) -> RunResult:
        """Play, learn, record, until the budget is spent, the stop criterion holds, or a stop is requested.

        Args:
            on_iteration: called with the metrics of every iteration.
            on_beat: called about every second where iterations may take longer.

        Raises:
            DivergedError: a policy has.
            ClusterError: rounds, or workers, keep failing.
            UnsavedError: the last checkpoint could not be written; earlier ones that could not are only warned of.
        """
        self._on_iteration = on_iteration
        while (reason := self._stop_reason()) is None:
            self._advance(on_beat)
        self._save_last()
        return RunResult(reason, self.iteration, self.num_env_steps)

    @abstractmethod
    def parameters(self) -> Parameters:
        """What is evaluated and published: the newest Bob, or the newest skills."""

    @abstractmethod
    def health(self) -> Health:
        """The state of its workers, right now."""

    @abstractmethod
    def grid(self) -> GoalGrid:
        """The task generator's goal grid."""

    @abstractmethod
    def close(self) -> None:
        """End what it started; a second call does nothing."""

    @abstractmethod
    def _advance(self, on_beat: OnBeat) -> None:
        """Go on by an iteration, or by as much of one as is done within a moment."""

    @abstractmethod
    def _save(self) -> None:
        """Write a checkpoint of the last iteration."""

    def _health_of_one(self, *, num_rollouts_counted: int) -> Health:
        """The health of a runner whose one actor is this process."""
        actor = ActorStatus(
            name="rollout-0",
            incarnation=0,
            state="alive",
            pid=os.getpid(),
            heartbeat=datetime.now(UTC),
            num_rollouts=self.iteration,
            num_env_steps=self.num_env_steps,
        )
        return Health((actor,), num_rollouts_counted=num_rollouts_counted)

    def _grid_of(self, cells: GoalCells, num_tries: IntArray, success_rate: StateArray) -> GoalGrid:
        """The grid of a runner that counts (cells,) tries and success rates itself; untried cells are left out."""
        centers = cells.centers().reshape(-1, 3)
        tried = tuple(
            GoalCell(
                center_m=tuple(np.round(centers[cell], 4).tolist()),
                num_tries=int(num_tries[cell]),
                success_rate=float(success_rate[cell]),
                learnability=float(success_rate[cell] * (1.0 - success_rate[cell])),
            )
            for cell in np.flatnonzero(num_tries)
        )
        lower, upper = cells.bounds_m
        return GoalGrid(
            iteration=self.iteration,
            num_env_steps=self.num_env_steps,
            cell_size_m=cells.cell_size_m,
            shape=cells.shape,
            num_cells=len(cells),
            lower_m=lower,
            upper_m=upper,
            cells=tried,
        )

    def _stop_reason(self) -> str | None:
        if self._stop_requested:
            return "interrupted"
        if self.bookkeeper.budget_spent:
            return "finished"
        return "converged" if self._converged else None

    def _open_directory(self, *, resume: bool) -> None:
        """Begin the run's records, or cut them back to where it goes on."""
        position = {"after_iteration": self.iteration, "after_env_steps": self.num_env_steps} if resume else {}
        self.directory.start(self.config, **position)
        if resume and not self.bookkeeper.saved:  # records are not as the checkpoint says, and that was accepted
            self._save()

    def _save_first(self) -> None:
        """Save an untrained run, so that one that is killed before its first interval can be resumed, too."""
        self._save()
        self._take_snapshot(after=-1)

    def _save_last(self) -> None:
        with self.bookkeeper.explaining_unsaved():
            if not self.bookkeeper.saved:
                self._save()

    def _metrics(self, result: IterationResult, elapsed_s: float) -> Metrics:
        """The metrics of an iteration that was counted and took ``elapsed_s``."""
        learned: Metrics = {}
        if result.updated is not None:
            learned = result.updated.metrics | {"time/learn_s": result.updated.update_s}
        return {
            "iteration": self.iteration,
            "env_steps": self.num_env_steps,
            **_round_metrics(result.rounds),
            **result.recorded.metrics,
            **learned,
            "actor/num_rollouts": float(len(result.rounds)),
            "actor/num_alive": float(result.num_actors_alive),
            "time/hand_over_s": result.hand_over_s,
            "time/learner_idle_fraction": max(0.0, 1.0 - learned.get("time/learn_s", 0.0) / elapsed_s),
            "time/wall_s": self.bookkeeper.wall_s,
            "time/env_steps_per_s": result.num_env_steps / elapsed_s,
        }

    def _count(self, result: IterationResult) -> None:
        """Count an iteration, and ask whether it is the last."""
        self.bookkeeper.count(result.num_env_steps)
        self._converged = result.recorded.should_stop

    def _record(self, result: IterationResult, metrics: Metrics) -> None:
        """Write the records of an iteration that was counted, and what is due after it."""
        with self.timing("record"):
            self.directory.record(metrics)
            self.directory.record_goals(self.iteration, self.num_env_steps, result.recorded.goals)
            self._on_iteration(metrics)
        self._keep(after=self.num_env_steps - result.num_env_steps)

    def _keep(self, *, after: int) -> None:
        """Write the snapshot and the checkpoint that are due; before this iteration there were ``after`` env steps."""
        with self.bookkeeper.tolerating("without this snapshot"):
            self._take_snapshot(after=after)
        if self.bookkeeper.save_due:
            with self.bookkeeper.tolerating(f"and saves again after {self.config.run.checkpoint_interval} iterations"):
                self._save()

    def _take_snapshot(self, *, after: int) -> None:
        if self.bookkeeper.snapshot_due(after=after):
            with self.timing("checkpoint"):
                self.bookkeeper.take_snapshot(self.parameters())


def _round_metrics(rounds: Sequence[RoundSummary]) -> Metrics:
    """Means of the rounds' own metrics, weighted by their worlds, and how many worlds broke."""
    num_worlds = np.array([each.num_worlds for each in rounds], dtype=np.float64)
    shares = num_worlds / num_worlds.sum()
    means = {name: float(shares @ [each.metrics[name] for each in rounds]) for name in rounds[0].metrics}
    return means | {
        "world/num_broken": float(sum(each.num_diverged for each in rounds)),
        "time/play_s": float(np.mean([each.play_s for each in rounds])),
    }
