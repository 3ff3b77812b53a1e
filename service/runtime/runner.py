"""What the two runners have in common for those who start them and tell how they go."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from service.errors import TandemError
from service.policies.parameters import Parameters
from service.runtime.bookkeeping import Books
from service.runtime.timing import Timing
from service.store.models import ActorStatus, GoalGrid

Metrics = dict[str, float]
OnIteration = Callable[[Metrics], None]
OnBeat = Callable[[], None]


class ClusterError(TandemError):
    """The cluster does not let the run go on; what it had learned is saved."""

    exit_code = 1


class StateLostError(ClusterError):
    """The state of learner or generator was lost with the machine that kept it; the newest checkpoint has it."""


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a run ended."""

    reason: str
    """``finished`` (budget), ``converged`` (the paper's stop criterion) or ``interrupted``."""
    iteration: int
    num_env_steps: int


@dataclass(frozen=True, slots=True)
class Health:
    """What a runner knows about its parts."""

    actors: tuple[ActorStatus, ...]
    num_rollouts_counted: int
    """Learned from, by the processes that run now."""
    num_rollouts_refused: int = 0
    warnings: tuple[str, ...] = ()
    last_error: str | None = None


def _nothing(*_: object) -> None:
    """For who wants to know nothing."""


class Runner(Protocol):
    """A pre-training run that can be started, watched and stopped."""

    timing: Timing

    @property
    def books(self) -> Books:
        """How far it is."""

    def run(self, on_iteration: OnIteration = _nothing, on_beat: OnBeat = _nothing) -> RunResult:
        """Play, learn, record, until the budget is spent, the stop criterion holds, or a stop is requested.

        Args:
            on_iteration: called with the metrics of every iteration.
            on_beat: called about every second where iterations may take longer.
        """

    def request_stop(self) -> None:
        """End soon, with a checkpoint. Safe to call from a signal handler."""

    def bob(self) -> Parameters:
        """The newest Bob, as he is evaluated and published."""

    def health(self) -> Health:
        """Of its parts, right now."""

    def grid(self) -> GoalGrid:
        """What its task generator knows about goals."""

    def close(self) -> None:
        """End what it started; a second call does nothing."""
