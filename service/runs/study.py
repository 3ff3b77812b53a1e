"""Runs a study: its runs side by side, then the best of them, a table and a picture.

Each run is a process of ``tandem train`` with a run directory of its own, so one that fails takes no other with it.
Consumes ``study.json`` and what the runs write into their directories; produces ``study.json``, progress, and at the
end ``results.csv`` and ``curves.png``. Waits for the next run to end.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from signal import SIGKILL, SIGTERM, Signals
from typing import Protocol

from service.base.errors import StorageError, StoreError, TandemError
from service.base.files import open_regular, open_to_append, os_errors, write_atomic
from service.base.lock import is_locked
from service.base.progress import answer, counted
from service.config import Config, dump_config, load_config
from service.config.self_play import SelfPlayConfig
from service.media.plots import plot_study
from service.registry.registry import Registry
from service.runs.progress import Progress
from service.runs.resuming import resumable_settings
from service.runs.signals import PASSED_ON, STOPPING, StopSignals
from service.runs.study_file import ENDED, StudyDirectory, StudyRun
from service.runs.study_results import SELECTED, as_csv, best_of, publish_best, select
from service.store.disk_reader import DiskReader, run_id_of
from service.store.models import OUTPUT_FILE, read_status
from service.store.run_directory import RunDirectory

POLL_S = 0.2
SHOW_S = 1.0
"""Time between two looks into the run directories."""
TAKEN_S = 60.0
"""Time that the process of an earlier study has to end, which is told that its study is gone."""
PATIENCE_S = (1.0, 5.0, 5.0)
"""Time that a process has to end after SIGTERM, a second SIGTERM, and SIGKILL."""
LAST_WORDS_BYTES = 100_000
"""End of a log in which a run said why it failed."""
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Job:
    """A run of a study, as it is sent to where it is to run."""

    directory: Path
    config: str
    """YAML of its configuration."""
    run: StudyRun
    options: tuple[str, ...] = ()
    """Of ``tandem train``."""
    first: tuple[str, ...] = ()
    """Options with which it only begins."""
    num_cores: int = 1
    device: str = "cpu"
    """Of its learner."""

    def left(self) -> StudyRun:
        """The run as its directory shows it, which no process runs now."""
        place = RunDirectory(self.directory)
        status = read_status(self.directory) if place.exists else None
        if status is None:
            return self.run.model_copy(update={"state": "interrupted" if place.exists else "waiting", "error": None})
        state, result = status.state, place.read_result()
        if state not in (*ENDED, "failed") or (
            state == "finished" and status.num_env_steps < self._config.run.total_env_steps  # it has a larger budget
        ):
            state, result = "interrupted", None
        found: dict[str, object] = {"state": state, "env_steps": status.num_env_steps, "error": None, "result": {}}
        if state == "failed":  # others have told of what they survived
            found["error"] = status.last_error
        if result is not None:
            found |= {"result": result["evaluation"], "wall_s": result["wall_s"]}
        return self.run.model_copy(update=found)

    def arguments(self) -> list[str]:
        """The arguments of ``tandem`` that begin the run or go on with it; nothing is published yet."""
        place = ["--run-dir", str(self.directory), "--no-publish"]
        if not RunDirectory(self.directory).exists:
            return ["train", str(self._config_file), *place, *self.options, *self.first]
        settings = [part for setting in resumable_settings(self._config) for part in ("--set", setting)]
        return ["train", "--resume", *place, *settings, *self.options]

    def write_config(self) -> None:
        """Put the configuration where the run is to begin, which another machine may not see otherwise."""
        with os_errors("write", self._config_file):
            self.directory.mkdir(parents=True, exist_ok=True)
            write_atomic(self._config_file, self.config.encode())

    @property
    def _config_file(self) -> Path:
        return self.directory.with_name(f"{self.directory.name}.yaml")

    @property
    def _config(self) -> Config:
        return load_config(self._config_file)


class Running(Protocol):
    """A run of a study that has been started."""

    def poll(self) -> StudyRun | None:
        """How it was left; None while it goes on."""

    def stop(self) -> None:
        """Ask it to end after its iteration, saved."""

    def close(self) -> None:
        """End it at once, if it goes on."""


class RunProcess:
    """The process of a run on this machine. What it says goes into its ``log.txt``."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._process: subprocess.Popen[bytes] | None = None
        self._stopping = False
        self._start_by_s = time.monotonic() + TAKEN_S

    def poll(self) -> StudyRun | None:
        """How the run was left; None while it goes on."""
        try:
            if self._process is None:
                return self._begin()
            code = self._process.poll()
            if code is None:
                return None
            found = self._job.left()
        except TandemError as error:  # its directory cannot be used; the other runs go on
            return self._job.run.model_copy(update={"state": "failed", "error": str(error)})
        asked = code in (0, *(128 + number for number in STOPPING)) or (self._stopping and -code in STOPPING)
        return found if asked else found.model_copy(update={"state": "failed", "error": self._reason(code)})

    def stop(self) -> None:
        """Ask it to end after its iteration, saved."""
        self._stopping = True
        if self._process is not None:
            self._process.send_signal(PASSED_ON)

    def close(self) -> None:
        """End it at once, if it goes on; it has a checkpoint that is at most an interval old."""
        for number, patience_s in zip((SIGTERM, SIGTERM, SIGKILL), PATIENCE_S, strict=True):
            if self._process is not None and self._process.poll() is None:
                self._process.send_signal(number)
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(patience_s)

    def _begin(self) -> StudyRun | None:
        if is_locked(self._job.directory) and time.monotonic() < self._start_by_s and not self._stopping:
            return None
        self._job.write_config()
        found = self._job.left()
        if found.has_ended or self._stopping:
            return found
        log_file = self._job.directory / OUTPUT_FILE
        with os_errors("write", log_file):
            log = open_to_append(log_file)
        command = [sys.executable, "-m", "service.cli.study_run", str(os.getpid()), *self._job.arguments()]
        with log:
            # A session of its own: Ctrl-C on a terminal is for this process, which passes it on.
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        return None

    def _reason(self, code: int) -> str:
        log_file = self._job.directory / OUTPUT_FILE
        if code < 0:
            said = f"ended by {Signals(-code).name}"
        else:
            text = ""
            with suppress(OSError), open_regular(log_file) as file:
                file.seek(max(0, file.seek(0, os.SEEK_END) - LAST_WORDS_BYTES))
                text = file.read(LAST_WORDS_BYTES).decode(errors="replace")
            lines = [line.strip() for line in text.splitlines()[-20:] if line.strip()]
            said = (lines[-1] if lines else f"exit code {code}").removeprefix("error: ")
        return f"{said[:500]}; all it said is in {log_file}"


@dataclass(frozen=True, slots=True)
class Place:
    """Where the runs of a study are: on this machine."""

    num_cores: int = field(default_factory=lambda: len(os.sched_getaffinity(0)))
    most_cores: int | None = None
    """Cores of its largest machine; None: of its only one."""
    start: Callable[[Job], Running] = RunProcess


def cores_of(config: Config) -> int:
    """The fewest cores of a run: one plays and another learns, and a task is learned by a thread that does both."""
    return 1 if config.makes == "orchestrator" else 2


def share(configs: Sequence[Config], place: Place, parallel: int | None) -> tuple[int, list[int]]:
    """Runs at once, and the cores of each: those of the configuration, else a share of all; of a task always one."""
    least = max(config.run.num_threads or cores_of(config) for config in configs)
    num_parallel = min(len(configs), parallel or max(1, place.num_cores // least))
    fair = max(1, min(place.num_cores // num_parallel, place.most_cores or place.num_cores))
    return num_parallel, [config.run.num_threads or (1 if cores_of(config) == 1 else fair) for config in configs]


class Study:
    """A study in its directory, which this process has claimed."""

    def __init__(self, directory: StudyDirectory, progress: Progress) -> None:
        self.directory, self._progress = directory, progress
        self.file = directory.read()
        self._configs = {name: directory.config(name).read_config() for name in self.file.runs}
        self._reader = DiskReader(directory.path)
        self._shown = dict.fromkeys(self.file.runs, 0)
        """Last iteration of each run that was shown."""

    def train(self, place: Place, parallel: int | None, options: Sequence[str], signals: StopSignals) -> None:
        """Run all runs that have not ended, several at once.

        The first signal ends them where they can be resumed; a second one raises, and ends them at once.

        Args:
            place: where they are.
            parallel: how many at once; None: as many as there are cores for.
            options: of ``tandem train`` for every run.
            signals: of this process.

        Raises:
            InterruptError: a second signal.
        """
        num_parallel, waiting = self._jobs(place, parallel, options)
        running: dict[str, Running] = {}
        stopping, told, last_s = False, False, float("-inf")

        def stop() -> None:
            nonlocal stopping
            stopping = True

        if waiting:
            self._progress.say(f"runs to go: {len(waiting)}, at once: {num_parallel}")
        try:
            with signals.asking(stop):
                while running or (waiting and not stopping):
                    while waiting and not stopping and len(running) < num_parallel:
                        name, job = waiting.popleft()
                        running[name] = place.start(job)
                        self._note(name, job.run.model_copy(update={"state": "running", "error": None}))
                    if stopping and not told:
                        answer("stopping each run after its iteration; again to end now")
                        told = True
                        for each in running.values():
                            each.stop()
                    time.sleep(POLL_S)
                    if time.monotonic() - last_s >= SHOW_S:
                        last_s = time.monotonic()
                        self._show()
                    for name, found in [(name, each.poll()) for name, each in running.items()]:
                        if found is not None:
                            del running[name]
                            self._note(name, found, aloud=True)
                self._show()
        finally:
            for each in running.values():
                each.close()
            for name in running:
                self._note(name, self.file.runs[name].model_copy(update={"state": "interrupted"}))

    def finish(self, registry: Registry | None) -> None:
        """Name the best of the runs that make primitives, publish it, and write the table and the picture.

        Args:
            registry: where it is published; None: nowhere.

        Raises:
            TandemError: something cannot be written or published.
        """
        runs = self.file.runs
        chosen = [name for name, run in runs.items() if run.has_ended and self._configs[name].makes == "primitives"]
        missing = [name for name in chosen if SELECTED not in runs[name].result]
        if missing:
            self._progress.say(f"learning is over; runs to evaluate: {len(missing)}")
        for name in counted(missing, "evaluating the runs", len(missing), "runs"):
            run = self.file.runs[name]
            try:
                self._note(name, run.model_copy(update={"result": run.result | select(self.directory.path / name)}))
            except TandemError as error:  # a damaged checkpoint
                self._note(name, run.model_copy(update={"state": "failed", "error": str(error)}))
        self.directory.write_file("results.csv", as_csv(self.file.runs))
        with suppress(TandemError):  # none has metrics yet
            plot_study({name: self.directory.path / name for name in runs}, self.directory.path / "curves.png")
        best = best_of(self.file.runs)
        self._write(best=best)  # known, whatever happens while it is published
        if best is not None and registry is not None:
            version = publish_best(self.directory.path / best, registry, self.file.runs[best])
            self._write(published=str(version) if version is not None else None)

    def _jobs(self, place: Place, parallel: int | None, options: Sequence[str]) -> tuple[int, deque[tuple[str, Job]]]:
        """How many runs are to go on at once, and those that have not ended."""
        names = [name for name, run in self.file.runs.items() if self._has_more(name, run)]
        num_parallel, cores = share([self._configs[name] for name in names], place, parallel) if names else (0, [])
        first = ("--from", self.file.start) if self.file.start is not None else ()
        jobs = deque[tuple[str, Job]]()
        for name, num in zip(names, cores, strict=True):
            config = self._configs[name]
            job = Job(
                directory=(self.directory.path / name).absolute(),
                config=dump_config(config),
                run=self.file.runs[name],
                options=(*options, "--set", f"run.num_threads={num}"),
                first=first,
                num_cores=num,
                device=config.learner.device if isinstance(config, SelfPlayConfig) else "cpu",
            )
            jobs.append((name, job))
        return num_parallel, jobs

    def _has_more(self, name: str, run: StudyRun) -> bool:
        larger = run.state == "finished" and run.env_steps < self._configs[name].run.total_env_steps
        return larger or not run.has_ended

    def _note(self, name: str, run: StudyRun, *, aloud: bool = False) -> None:
        self.file = self.file.model_copy(update={"runs": self.file.runs | {name: run}})
        try:
            self._write()
        except StorageError as error:  # the runs go on
            _logger.warning("%s", error)
        if aloud:
            why = f": {run.error}" if run.error else ""
            self._progress.say(f"{name}: {run.state} after {run.env_steps:,} env steps{why}")

    def _write(self, **changed: str | None) -> None:
        self.file = self.file.model_copy(update=changed)
        self.directory.write(self.file)

    def _show(self) -> None:
        for name in self.file.runs:
            path = self.directory.path / name
            with suppress(StoreError):  # it has not begun, is elsewhere, or the disk is away for a moment
                for record in self._reader.metrics(run_id_of(path), after_iteration=self._shown[name]):
                    self._shown[name] = int(record["iteration"] or 0)
                    self._progress.show(record, name, self._configs[name].run.total_env_steps)
