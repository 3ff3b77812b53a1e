"""The interface of what a run trains: it learns in steps, and knows nothing of the run around it."""

from __future__ import annotations

import operator
import os
import time
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np

from service.actors.rollout import Diverged
from service.base.errors import TandemError
from service.base.types import IntArray, Metrics, StateArray
from service.generator.bins import GoalCells
from service.policies.parameters import Parameters
from service.store.models import ActorStatus, GoalCell, GoalGrid

State = Mapping[str, Any]
"""By the name of a component its arrays, which have names of their own, or plain values as JSON has them."""


class WorkersError(TandemError):
    """A method's workers, such as those on a cluster, do not let the run go on; what it had learned is saved."""

    exit_code = 1


class StateLostError(WorkersError):
    """A state was lost with the machine that kept it; the newest checkpoint has one."""

    def __init__(self, lost: str) -> None:
        """Say what was lost, and how the run goes on."""
        super().__init__(f"{lost}; the run goes back to its newest checkpoint")


@dataclass(frozen=True, slots=True)
class Iteration:
    """Results of an iteration that has ended."""

    metrics: Metrics
    """By name, such as ``bob/success_rate``; ``iteration`` and ``env_steps`` among them."""
    goals: StateArray | None = None
    """(M, 6 K + 1) a sample of its goals: starts of K objects, their goals (x y z, metres), solved 0/1; or None."""
    diverged: Mapping[str, Diverged] = field(default_factory=dict)
    """By the name of a round: states and actions of worlds whose physics diverged in it."""


@dataclass(frozen=True, slots=True)
class Health:
    """The state of a method's workers."""

    actors: tuple[ActorStatus, ...]
    num_rollouts_counted: int
    """Learned from; on a cluster those of the processes that run now."""
    num_rollouts_refused: int = 0
    warnings: tuple[str, ...] = ()
    last_error: str | None = None


class Timing:
    """Wall-clock time of a run by named section; ``with timing("learn"): ...`` adds to it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        """Seconds spent in each named section, in order of first use."""
        self._start = time.perf_counter()

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Count the time of a ``with`` block under ``name``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] += time.perf_counter() - start

    def tree(self) -> str:
        """A line per section with its seconds and its share of the time since this object was made."""
        total = time.perf_counter() - self._start
        lines = [f"total {total:9.1f} s"]
        lines += [f"  {name:<18}{spent:9.1f} s {100 * spent / total:5.1f} %" for name, spent in self.seconds.items()]
        other = total - sum(self.seconds.values())
        return "\n".join([*lines, f"  {'other':<18}{other:9.1f} s {100 * other / total:5.1f} %"])


class Method(ABC):
    """The base class of what learns in a run.

    Call order: ``start`` once; then ``step`` again and again, with ``evaluate``, ``state`` and the others in between;
    ``close`` at the end. A method that continues from what ``state`` gave learns what it would have learned without
    the interruption, bit for bit.
    """

    def __init__(self) -> None:
        self.iteration = 0
        """Finished iterations."""
        self.num_env_steps = 0
        """Env steps of all finished iterations."""
        self.converged = False
        """Whether there is nothing more to learn; the run then ends before its budget is spent."""
        self.timing = Timing()
        self.on_wait: Callable[[], None] = lambda: None
        """To be called again and again while ``step`` or ``start`` wait for another process."""

    @property
    def remedy(self) -> str:
        """What a user may do about a policy that has diverged."""
        return "begin another run with a lower learning rate"

    def measure(self) -> Metrics:
        """Measure the final result, on goals that were used for nothing else."""
        return {}

    def start(self, state: State | None = None) -> None:
        """Begin, or continue from a state; ``iteration`` and ``num_env_steps`` have been set."""
        if state is not None:
            self.load_state(state)

    @abstractmethod
    def step(self) -> Iteration | None:
        """Go on by an iteration, or by as much of one as is done within a moment.

        Returns:
            The iteration that has ended; None where it goes on.

        Raises:
            DivergedError: a policy is no longer finite.
            StateLostError: the newest state is lost.
        """

    def evaluate(self) -> Metrics:
        """Measure what has been learned; a method may also start to, and give the metrics with a later iteration."""
        return {}

    @abstractmethod
    def parameters(self) -> Parameters:
        """What is evaluated, kept in snapshots and published."""

    def health(self) -> Health:
        """The state of its workers, right now; of a method in one process that of this process."""
        actor = ActorStatus(
            name="rollout-0",
            incarnation=0,
            state="alive",
            pid=os.getpid(),
            heartbeat=datetime.now(UTC),
            num_rollouts=self.iteration,
            num_env_steps=self.num_env_steps,
        )
        return Health((actor,), num_rollouts_counted=self.iteration)

    def grid(self) -> GoalGrid | None:
        """What is known of goals by cells of the workspace; None for a method without goals."""
        return None

    @abstractmethod
    def state(self) -> State:
        """Everything that ``load_state`` continues from."""

    @abstractmethod
    def load_state(self, state: State) -> None:
        """Go back to a state."""

    @abstractmethod
    def close(self) -> None:
        """End what it started; a second call does nothing."""

    def count(self, num_env_steps: int) -> dict[str, float]:
        """Count an iteration and its env steps, and return both as metrics.

        Raises:
            ValueError: fewer than 0.
            TypeError: no whole number.
        """
        if num_env_steps < 0:
            raise ValueError(f"count of {num_env_steps} env steps; give 0 or more")
        self.iteration += 1
        self.num_env_steps += operator.index(num_env_steps)  # of NumPy's, which cannot be saved, a plain one
        return {"iteration": self.iteration, "env_steps": self.num_env_steps}


def goal_grid(
    cells: GoalCells,
    shown: IntArray,
    num_tries: IntArray,
    success_rate: StateArray,
    iteration: int,
    num_env_steps: int,
) -> GoalGrid:
    """The grid of what is known of goals after an iteration.

    Args:
        cells: of the workspace.
        shown: (M,) indices of those that the grid has.
        num_tries: (cells,) tries.
        success_rate: (cells,) of these.
        iteration: finished iterations.
        num_env_steps: their env steps.
    """
    centers = cells.centers().reshape(-1, 3)
    if cells.num_objects > 1:  # a place is one cell, whichever object's goal is there
        tries = num_tries.reshape(cells.num_objects, -1)
        weight = tries + 1e-9
        success_rate = (success_rate.reshape(tries.shape) * weight).sum(axis=0) / weight.sum(axis=0)
        num_tries, shown = tries.sum(axis=0), np.unique(shown % len(centers))
    lower, upper = cells.bounds_m
    return GoalGrid(
        iteration=iteration,
        num_env_steps=num_env_steps,
        cell_size_m=cells.cell_size_m,
        shape=cells.shape,
        num_cells=len(centers),
        lower_m=lower,
        upper_m=upper,
        cells=tuple(
            GoalCell(
                center_m=tuple(np.round(centers[cell], 4).tolist()),
                num_tries=int(num_tries[cell]),
                success_rate=round(float(success_rate[cell]), 4),
                learnability=round(float(success_rate[cell] * (1.0 - success_rate[cell])), 4),
            )
            for cell in shown
        ),
    )
