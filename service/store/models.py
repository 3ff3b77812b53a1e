"""The report of a run about itself, as its runner writes it and the status service hands it out.

| file in the run directory | content |
|---|---|
| ``status.json`` | ``RunStatus``, at every change of state or condition and else about once a second |
| ``goals.json`` | ``GoalGrid``, about every five seconds |
| ``stop`` | is there when the run was asked to stop |

Metrics are in ``metrics.jsonl``, where the run writes them for itself.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal, NamedTuple, Self, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import AwareDatetime, Field

from service.base.files import read_regular
from service.base.parsing import ParseError, parse_with
from service.config.frozen import FrozenModel

MAX_BYTES = 64 * 1024 * 1024
"""Greatest size of a file of JSON in the directory of a run or a study, but for records."""
CONFIG_FILE = "config.yaml"
METRICS_FILE = "metrics.jsonl"
"""Records, one line for each iteration."""
GOALS_FILE = "goals.jsonl"
"""Samples of valid proposals, one line for each iteration."""
STATUS_FILE = "status.json"
GRID_FILE = "goals.json"
"""What is known of goals, by cells."""
STOP_FILE = "stop"
STUDY_FILE = "study.json"
"""In the directory of a study, which has a run directory for each of its runs."""
OUTPUT_FILE = "log.txt"
"""All that the processes of a study's run said."""
RunState = Literal["starting", "running", "finished", "converged", "interrupted", "failed"]
ACTIVE: frozenset[RunState] = frozenset({"starting", "running"})
MAX_AHEAD = timedelta(seconds=5)
"""A heartbeat from further in the future says that two clocks differ."""
SILENT_AFTER = timedelta(seconds=60)
"""A run without a word for so long may have lost its process, killed or cut off from power."""
Condition = Literal["well", "clock", "redis", "disk", "stuck", "silent"]
"""What a run that has not ended suffers from, the worst last; ``RunStatus.warnings`` has it in words.

| condition | meaning |
|---|---|
| ``well`` | nothing |
| ``clock`` | its heartbeat comes from the future, or a minute late: its machine's clock and the reader's differ |
| ``redis`` | it is configured to report to Redis, which takes nothing |
| ``disk`` | its files cannot be written, most likely because the disk is full |
| ``stuck`` | its process has the run, and says nothing: it is frozen, or hangs |
| ``silent`` | it says nothing, and it is not known here whether its process lives |
"""
CONDITIONS: tuple[Condition, ...] = get_args(Condition)
RUN_ID = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,127}$"
Record = dict[str, float | None]
"""One iteration's metrics; ``iteration`` and ``env_steps`` are always there. Null: JSON has no number for it."""


@dataclass(frozen=True, slots=True)
class Columns:
    """Metrics of a run over its iterations; NaN where an iteration has none."""

    iteration: NDArray[np.int64]
    env_steps: NDArray[np.int64]
    metrics: dict[str, NDArray[np.float64]]
    names: tuple[str, ...]
    """Of all metrics that the run has, sorted."""


class Trouble(NamedTuple):
    """Something that is not as it should be, and what it is in words."""

    condition: Condition
    text: str


class RunTotals(FrozenModel):
    """Work that all processes that ever ran a run have done; what was done again after going back counts again."""

    iterations: int = Field(0, ge=0)
    env_steps: int = Field(0, ge=0)
    rollouts_counted: int = Field(0, ge=0)
    rollouts_refused: int = Field(0, ge=0)
    replacements: int = Field(0, ge=0, description="of actors, learner and generator")


class ActorStatus(FrozenModel):
    """One rollout actor, the learner or the task generator, as its run sees it."""

    name: str = Field(description="rollout-0, rollout-1, ..., learner, generator")
    incarnation: int = Field(ge=0, description="which of its processes this is; those before a resume count, too")
    num_replaced: int = Field(0, ge=0, description="how often it was replaced since the run was last started")
    state: Literal["starting", "alive"]
    node: str = Field("", description="host it is on; empty in a run of one process")
    pid: int | None = None
    heartbeat: AwareDatetime = Field(description="UTC, when it was last heard of")
    num_rollouts: int = Field(0, ge=0, description="taken from it, all incarnations together")
    num_env_steps: int = Field(0, ge=0)
    last_error: str | None = Field(None, description="why its last incarnation was replaced")


class Trial(FrozenModel):
    """The task that a run learns, and how well it does in the end."""

    task: str = Field(examples=["push"])
    method: str = Field(examples=["ours-her"])
    seed: int = Field(ge=0)
    primitives: str | None = Field(None, description="NAME@VERSION or directory of what it composes; null for nothing")
    primitives_digest: str | None = Field(None, description="SHA-256 of their parameters")
    success: float | None = Field(None, description="at the last step, once it has ended; share of episodes")
    success_low: float | None = Field(None, description="of its 95 % interval over these episodes (Wilson)")
    success_high: float | None = None
    success_ever: float | None = Field(None, description="at any step")
    num_episodes: int | None = Field(None, description="of that evaluation")


class RunStatus(FrozenModel):
    """The state of a run right now."""

    run_id: str = Field(pattern=RUN_ID)
    name: str = Field(description="registry name of what it makes")
    study: str | None = Field(None, description="that the run is part of, as far as its directory tells")
    trial: Trial | None = Field(None, description="of a run that learns a task; null for others")
    runtime: Literal["local", "ray"]
    state: RunState
    started: AwareDatetime = Field(description="UTC, of the process that runs it now or ran it last")
    heartbeat: AwareDatetime = Field(description="UTC, when its runner last wrote this")
    identity: str = Field("", description="the same after every resume; another run with this id has another one")
    epoch: int = Field(0, ge=0, description="number of that process among those that ever ran it")
    iteration: int = Field(0, ge=0)
    num_env_steps: int = Field(0, ge=0)
    total_env_steps: int = Field(ge=1, description="its budget")
    options: tuple[str, ...] = Field((), description="of the command that goes on with it, which no other file has")
    env_steps_per_s: float = Field(0.0, ge=0)
    policy_version: int = Field(0, ge=0)
    policy_lag: float = Field(0.0, ge=0, description="mean over the last update's rollouts, in versions")
    num_rollouts_counted: int = Field(0, ge=0, description="learned from, each once")
    num_rollouts_refused: int = Field(0, ge=0, description="seen before, or too old")
    totals: RunTotals = Field(RunTotals(), description="never fall, whereas a run that goes back to a checkpoint does")
    condition: Condition = Field("well", description="the worst that it suffers from; warnings say what it is")
    stopping: bool = Field(False, description="a stop was requested and the run has not ended yet")
    published: str | None = Field(None, description="NAME@VERSION of the primitives it published last")
    last_error: str | None = None
    warnings: tuple[str, ...] = Field((), description="what is not as it should be right now, such as Redis being away")
    actors: tuple[ActorStatus, ...] = ()

    def suffering(self, condition: Condition, text: str) -> Self:
        """The status with another trouble, and the worst of the two as its condition."""
        worst = max(self.condition, condition, key=CONDITIONS.index)
        return self.model_copy(update={"condition": worst, "warnings": (*self.warnings, text)})

    def vanished(self) -> Self:
        """The status of a silent run that no process runs any more: it must not seem to run for ever."""
        when = self.heartbeat.astimezone(UTC).isoformat(timespec="seconds")
        error = (
            f"its process vanished without a word, last heard of at {when}; --resume goes on from its last checkpoint"
        )
        ended = {"state": "interrupted", "condition": "well", "warnings": (), "stopping": False, "last_error": error}
        return self.model_copy(update=ended)


def read_status(directory: Path) -> RunStatus | None:
    """The status that the last process of a run left in its directory; None where there is none that can be read."""
    try:
        return parse_with(RunStatus.model_validate_json, read_regular(directory / STATUS_FILE, MAX_BYTES), STATUS_FILE)
    except (OSError, ParseError):
        return None


class Pulse:
    """Age of the heartbeats of runs, as their reader's own clock counts it: clocks of two machines differ, and jump.

    The first time that a run is asked about, its heartbeat is as old as the clocks say. From then on it grows older by
    this process's own clock, until there is another one.

    Args:
        clock: counts seconds, and never jumps.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seen: dict[str, tuple[datetime, float, float, float]] = {}
        """By run: its heartbeat, the clock at that and at the last look, and by how much that heartbeat came late."""

    def look(self, status: RunStatus) -> tuple[RunStatus, float]:
        """The status of a run, with a warning where a clock is wrong; and seconds since it was heard of, at least 0."""
        heartbeat, now_s = status.heartbeat, self._clock()
        age = datetime.now(UTC) - heartbeat
        begun_s = now_s - max(0.0, age.total_seconds())
        last, beat_s, looked_s, late_s = self._seen.get(status.run_id, (heartbeat, begun_s, now_s, 0.0))
        if heartbeat != last:  # it came at some time since the last look
            beat_s, late_s = max(begun_s, looked_s), looked_s - begun_s
        self._seen[status.run_id] = heartbeat, beat_s, now_s, late_s
        where = None
        if -age > MAX_AHEAD:
            where = f"{-age.total_seconds():.0f} s in the future"
        elif late_s > SILENT_AFTER.total_seconds():
            where = f"{late_s:.0f} s in the past as it comes"
        if status.state in ACTIVE and where is not None:
            text = f"its heartbeat is {where}: the clock of its machine, or the one here, is wrong"
            status = status.suffering("clock", text)
        return status, now_s - beat_s


class GoalCell(FrozenModel):
    """One cell of the task generator's grid in which a valid goal was ever proposed."""

    center_m: tuple[float, float, float]
    num_tries: int = Field(ge=0, description="of Bob, ever")
    success_rate: float = Field(ge=0, le=1, description="of the present Bob, estimated; 1/2 where untried")
    learnability: float = Field(ge=0, le=0.25, description="p (1 - p)")


class GoalGrid(FrozenModel):
    """The task generator's estimates of goals."""

    iteration: int = Field(ge=0)
    num_env_steps: int = Field(ge=0)
    cell_size_m: float = Field(gt=0)
    shape: tuple[int, int, int]
    num_cells: int = Field(ge=0, description="in the workspace, seen or not")
    lower_m: tuple[float, float, float] = Field(description="corner of the workspace, metres")
    upper_m: tuple[float, float, float]
    cells: tuple[GoalCell, ...]


class RunReader(ABC):
    """A place the status service reads runs from.

    Every method may raise ``StoreUnavailableError``, and ``DamagedStoreError`` where the store holds what no run has
    written. Those that take a run id raise ``UnknownRunError`` where there is no such run.
    """

    @abstractmethod
    def runs(self) -> list[RunStatus]:
        """All runs, newest start first."""

    @abstractmethod
    def run(self, run_id: str) -> RunStatus:
        """One run."""

    @abstractmethod
    def metrics(self, run_id: str, *, after_iteration: int = 0, most: int | None = None) -> list[Record]:
        """The records of iterations above ``after_iteration``, in order, each iteration once (a resumed run's last).

        At most ``most`` of them, the first ones.
        """

    @abstractmethod
    def newest(self, run_id: str) -> Record | None:
        """The newest record; None before the first. Fast, however long the run is."""

    @abstractmethod
    def columns(self, run_id: str, names: Sequence[str] | None) -> Columns:
        """These metrics of all iterations, None for all metrics; those that the run does not have are left out."""

    @abstractmethod
    def sample(self, run_id: str, name: str, number: int) -> list[float | None]:
        """One metric of about ``number`` records, evenly over the run: fast, whatever else the run has recorded."""

    @abstractmethod
    def goals(self, run_id: str) -> GoalGrid | None:
        """The newest grid; None before the first."""

    @abstractmethod
    def request_stop(self, run_id: str) -> None:
        """Ask a run to end after its current iteration, saved; nothing happens if it has ended."""

    def directories(self) -> dict[str, Path]:
        """The directories of the runs that are on this machine, by their ids. Raises nothing."""
        return {}

    def directory(self, run_id: str) -> Path | None:
        """The directory of a run; None if it is not on this machine. No id leads elsewhere. Raises nothing."""
        return self.directories().get(run_id)

    @abstractmethod
    def ready(self) -> None:
        """Return if reads work right now."""
