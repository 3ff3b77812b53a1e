"""One run of a study: how far it is, and the process of ``tandem train`` that it is on some machine."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from signal import SIGKILL, SIGTERM, Signals
from typing import Literal

from pydantic import Field

from service.base.cores import usable_cores
from service.base.errors import ConfigError, TandemError
from service.base.files import last_lines, open_to_append, os_errors, write_atomic
from service.base.lock import is_locked
from service.config import Config
from service.config.frozen import FrozenModel
from service.runs.grid import Settings
from service.runs.signals import PARENT, PASSED_ON, STOPPING
from service.store.models import OUTPUT_FILE, RunState, read_status
from service.store.run_directory import RunDirectory

GO_ON, STOP, END_NOW = range(3)
"""What a run is asked for: a stop is after its iteration, saved."""
POLL_S = 0.2
TAKEN_S = 150.0
"""Time that the process of an earlier study has to end, which is told that its study is gone.

An NFS server keeps the lock of a machine that is lost for a lease, of 90 s by default.
"""
PATIENCE_S = (1.0, 5.0, 5.0)
"""Time that a process has to end after SIGTERM, a second SIGTERM, and SIGKILL."""
Asked = Callable[[], int]
"""Says ``GO_ON``, ``STOP`` or ``END_NOW``."""


class StudyRun(FrozenModel):
    """How far a run of a study is."""

    settings: Settings = Field(description="by which it differs from others")
    state: RunState | Literal["waiting"] = "waiting"
    env_steps: int = 0
    wall_s: float = 0.0
    error: str | None = Field(None, description="reason of a failure, in one line")
    result: dict[str, float] = Field({}, description="what was measured at its end")

    @property
    def has_ended(self) -> bool:
        """Whether it has learned all it was to learn."""
        return self.state in ("finished", "converged")

    def has_more(self, total_env_steps: int) -> bool:
        """Whether it is to learn more: it has not ended, or has a larger budget by now."""
        return not self.has_ended or (self.state == "finished" and self.env_steps < total_env_steps)

    def now(self, state: RunState | Literal["waiting"], error: str | None = None) -> StudyRun:
        """The run in another state."""
        return self.model_copy(update={"state": state, "error": error})


@dataclass(frozen=True, slots=True)
class Job:
    """A run of a study, as it is sent to where it is to run."""

    directory: Path
    config: str
    """YAML of its configuration."""
    total_env_steps: int
    run: StudyRun
    options: tuple[str, ...] = ()
    """Of ``tandem train``."""
    num_cores: int = 1
    device: str = "cpu"
    """Of its learner."""

    def left(self) -> StudyRun:
        """The run as its directory shows it, which no process runs now."""
        place = RunDirectory(self.directory)
        status = read_status(self.directory) if place.exists else None
        if status is None:
            return self.run.now("interrupted" if place.exists else "waiting")
        found = self.run.model_copy(update={"env_steps": status.num_env_steps, "result": {}})
        found = found.now(status.state, status.last_error if status.state == "failed" else None)
        if found.state != "failed" and found.has_more(self.total_env_steps):
            return found.now("interrupted")
        result = place.read_result()
        if result is None or result["env_steps"] != status.num_env_steps:  # or of a shorter budget, before it failed
            result = {"evaluation": {}, "wall_s": found.wall_s}
        return found.model_copy(update={"result": result["evaluation"], "wall_s": result["wall_s"]})

    def arguments(self) -> list[str]:
        """The arguments of ``tandem`` that begin the run or go on with it; nothing is published yet.

        Its configuration is put beside the run directory, which another machine may not see otherwise.
        """
        file = self.directory.with_name(f"{self.directory.name}.yaml")
        with os_errors("write", file):
            self.directory.mkdir(parents=True, exist_ok=True)
            write_atomic(file, self.config.encode())
        return ["train", str(file), "--run-dir", str(self.directory), "--resume=auto", "--no-publish", *self.options]


def run_process(job: Job, asked: Asked) -> StudyRun:
    """Run a job in a process of this machine, which says what it has to say into ``log.txt`` of its directory.

    A process that is to end now has a checkpoint that is at most an interval old.

    Returns:
        How the run was left.
    """
    try:
        start_by_s = time.monotonic() + TAKEN_S
        while is_locked(job.directory) and time.monotonic() < start_by_s and not asked():
            time.sleep(POLL_S)
        found = job.left()
        if found.has_ended or asked():
            return found
        code, told = _wait_for(_start(job), asked)
        found = job.left()
    except (TandemError, OSError) as error:  # no process for it, or its directory cannot be used; the others go on
        return job.run.now("failed", str(error))
    if code in (0, *(128 + number for number in STOPPING)) or (told and -code in STOPPING):
        return found
    return found.now("failed", _reason(job.directory / OUTPUT_FILE, code))


def _start(job: Job) -> subprocess.Popen[bytes]:
    command, log_file = [sys.executable, "-m", "service", *job.arguments()], job.directory / OUTPUT_FILE
    with os_errors("write", log_file):
        log = open_to_append(log_file)
    with log:
        # A session of its own: Ctrl-C on a terminal is for this process, which passes it on.
        return subprocess.Popen(
            command, env={**os.environ, PARENT: str(os.getpid())}, start_new_session=True,
            stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
        )  # fmt: skip


def _wait_for(process: subprocess.Popen[bytes], asked: Asked) -> tuple[int, int]:
    """The exit code of a process, and what it was asked for."""
    told = GO_ON
    while process.poll() is None:
        if (now := asked()) > told:
            told = now
            process.send_signal(PASSED_ON)
        if told == END_NOW:
            for number, patience_s in zip((SIGTERM, SIGTERM, SIGKILL), PATIENCE_S, strict=True):
                process.send_signal(number)  # which does nothing where it has ended
                with suppress(subprocess.TimeoutExpired):
                    process.wait(patience_s)
        time.sleep(POLL_S)
    return process.returncode, told


def _reason(log_file: Path, code: int) -> str:
    if code < 0:
        said = f"ended by {Signals(-code).name}"
    else:
        lines = last_lines(log_file)
        said = lines[-1].strip().removeprefix("error: ") if lines else f"exit code {code}"
    return f"{said[:500]}; all it said is in {log_file}"


@dataclass(frozen=True, slots=True)
class Place:
    """Where the runs of a study are: on this machine."""

    num_cores: int = field(default_factory=usable_cores)
    most_cores: int | None = None
    """Cores of its largest machine; None: of its only one."""
    run: Callable[[Job, Asked], StudyRun] = run_process
    """Runs a job until it ends, or until what was asked for is done; called in a thread."""


def share(configs: Sequence[Config], place: Place, parallel: int | None) -> tuple[int, list[int]]:
    """Runs at once, and the cores of each: those of the configuration, else a share of all.

    A run has two at least, as one plays and another learns. A task is learned by a thread that does both, and has one.
    """
    one = [config.makes == "orchestrator" for config in configs]
    least = max(each.run.num_threads or (1 if alone else 2) for each, alone in zip(configs, one, strict=True))
    num_parallel = min(len(configs), parallel or max(1, place.num_cores // least))
    fair = max(1, min(place.num_cores // num_parallel, place.most_cores or place.num_cores))
    cores = [each.run.num_threads or (1 if alone else fair) for each, alone in zip(configs, one, strict=True)]
    if place.most_cores is not None and max(cores) > place.most_cores:  # Ray would wait for such a machine for ever
        raise ConfigError(
            f"run.num_threads = {max(cores)}, and the largest machine has {place.most_cores} cores: give no more"
        )
    return num_parallel, cores
