"""The processes of a study: one for each run, so that a run that fails takes no other with it.

They run ``tandem pretrain`` and talk through their run directories alone. What they say goes into their ``log.txt``.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from signal import SIGKILL, SIGTERM, Signals

from service.io.errors import StorageError
from service.io.files import os_errors
from service.io.study_directory import StudyDirectory
from service.progress import answer
from service.regular_files import open_regular, open_to_append
from service.runs.signals import PASSED_ON, STOPPING, StopSignals
from service.runtime.progress import Progress
from service.store.disk_reader import DiskReader, run_id_of
from service.store.errors import StoreError, UnknownRunError
from service.store.models import RunState, RunStatus

POLL_S = 0.2
SHOW_S = 1.0
"""Time between two looks into the run directories."""
GRACE_S = 5.0
"""Time that a run has to end at once before it is killed."""
LAST_WORDS_BYTES = 100_000
"""End of a log in which a run said why it failed."""
ENDED: frozenset[RunState] = frozenset({"finished", "converged"})
"""States in which a run has learned all it was to learn."""
_logger = logging.getLogger(__name__)

Command = Callable[[int], Sequence[str]]
"""The arguments of ``tandem`` that begin, or resume, the run of a seed."""


@dataclass(frozen=True, slots=True)
class RunEnd:
    """The state in which a run was left."""

    seed: int
    state: RunState | None
    """None: it never began."""
    num_env_steps: int = 0
    wall_s: float = 0.0
    """Seconds spent on iterations, by all processes that ran this run."""
    error: str | None = None
    """Reason of a failure, in one line."""

    @property
    def has_ended(self) -> bool:
        """Whether it has learned all it was to learn."""
        return self.state in ENDED


class Study:
    """Runs the runs of a study that have not ended, several at once.

    Consumes what they write into their directories, and produces ``study.json`` and progress; waits for the next of
    them to end.

    Args:
        directory: of the study, which this process has claimed.
        seeds: of the runs.
        total_env_steps: of each run.
        start: reference of what they begin from.
    """

    def __init__(
        self, directory: StudyDirectory, seeds: Sequence[int], total_env_steps: int, start: str | None = None
    ) -> None:
        self._directory, self._total, self._start_from = directory, total_env_steps, start
        self._reader = DiskReader(directory.path)
        self._processes: dict[int, subprocess.Popen[bytes]] = {}
        self._shown = dict.fromkeys(seeds, 0)
        """Last iteration of each run that was shown."""
        self._stopping = False
        self.runs = {seed: self._found(seed) for seed in seeds}
        """State in which each run was left, by its seed."""

    @property
    def unfinished(self) -> list[int]:
        """Seeds whose runs have not ended."""
        return [seed for seed, run in self.runs.items() if not run.has_ended]

    def run(self, command: Command, num_parallel: int, signals: StopSignals, progress: Progress) -> None:
        """Run all runs that have not ended.

        The first signal ends them where they can be resumed; a second one raises, and ends them at once.

        Args:
            command: what begins or resumes a run.
            num_parallel: how many at once.
            signals: of this process.
            progress: where the runs are shown.

        Raises:
            InterruptError: a second signal.
        """
        waiting, last_s = deque(self.unfinished), float("-inf")
        told = False
        try:
            with signals.asking(self._stop):
                while self._processes or (waiting and not self._stopping):
                    while waiting and not self._stopping and len(self._processes) < num_parallel:
                        self._start(waiting.popleft(), command)
                    if self._stopping and not told:
                        answer("stopping each run after its iteration; again to end now")
                        self._signal(PASSED_ON)
                        told = True
                    time.sleep(POLL_S)
                    if time.monotonic() - last_s >= SHOW_S:
                        last_s = time.monotonic()
                        with suppress(StoreError):  # a disk that is away for a moment
                            self._show(progress)
                    for seed in [seed for seed, process in self._processes.items() if process.poll() is not None]:
                        self._end(seed, progress)
                with suppress(StoreError):
                    self._show(progress)
        finally:
            self._end_at_once()

    def save(self, more: Mapping[str, object] | None = None) -> None:
        """Write ``study.json``.

        Args:
            more: what else is known of the study.
        """
        runs = {
            str(run.seed): {
                "state": "running" if run.seed in self._processes else run.state or "waiting",
                "env_steps": run.num_env_steps,
                "wall_s": round(run.wall_s, 1),
                "error": run.error,
            }
            for run in self.runs.values()
        }
        self._directory.write_results(
            {"seeds": list(self.runs), "from": self._start_from, "runs": runs, **(more or {})}
        )

    def _start(self, seed: int, command: Command) -> None:
        log_file = self._directory.log_file(seed)
        arguments = [sys.executable, "-m", "service.cli.study_run", str(os.getpid()), *command(seed)]
        with os_errors("write", log_file):
            log_file.parent.mkdir(parents=True, exist_ok=True)
            log = open_to_append(log_file)
        with log:
            # A session of its own: Ctrl-C on a terminal is for this process, which passes it on.
            self._processes[seed] = subprocess.Popen(
                arguments, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        self._save_if_possible()

    def _end(self, seed: int, progress: Progress) -> None:
        code = self._processes.pop(seed).returncode
        run = self._found(seed)
        if code not in (0, *(128 + number for number in STOPPING)) and not (self._stopping and -code in STOPPING):
            run = RunEnd(seed, "failed", run.num_env_steps, run.wall_s, self._reason(seed, code))
        self.runs[seed] = run
        self._save_if_possible()
        said = run.state or "stopped before it began"
        progress.say(
            f"seed {seed}: {said} after {run.num_env_steps:,} env steps{': ' + run.error if run.error else ''}"
        )

    def _save_if_possible(self) -> None:
        try:
            self.save()
        except StorageError as error:  # the runs go on
            _logger.warning("%s", error)

    def _reason(self, seed: int, code: int) -> str:
        log_file = self._directory.log_file(seed)
        if code < 0:
            said = f"ended by {Signals(-code).name}"
        else:
            try:
                with open_regular(log_file) as file:
                    file.seek(max(0, file.seek(0, os.SEEK_END) - LAST_WORDS_BYTES))
                    text = file.read(LAST_WORDS_BYTES).decode(errors="replace")
            except OSError:
                text = ""  # the other runs go on
            lines = [line.strip() for line in text.splitlines()[-20:]]
            said = next((line for line in reversed(lines) if line), f"exit code {code}").removeprefix("error: ")
        return f"{said[:500]}; all it said is in {log_file}"

    def _found(self, seed: int) -> RunEnd:
        """A run as its directory shows it."""
        try:
            status = self._status(seed)
            if status is None:
                return RunEnd(seed, None)
            records = self._reader.metrics(status.run_id, after_iteration=max(0, status.iteration - 1))
        except StoreError as error:  # its directory cannot be read; the other runs go on
            return RunEnd(seed, "failed", error=str(error))
        newest = records[-1] if records else {}
        num_env_steps = max(status.num_env_steps, int(newest.get("env_steps") or 0))  # a killed run said less
        state = status.state
        if state == "finished" and num_env_steps < self._total:
            state = "interrupted"  # it has a larger budget now
        elif state not in ENDED and state != "failed":
            state = "interrupted"  # nobody runs it, whatever it said last
        reason = status.last_error if state == "failed" else None  # others have told of what they survived
        return RunEnd(seed, state, num_env_steps, newest.get("time/wall_s") or 0.0, reason)

    def _status(self, seed: int) -> RunStatus | None:
        try:
            return self._reader.run(run_id_of(self._directory.run(seed).path))
        except UnknownRunError:
            return None

    def _show(self, progress: Progress) -> None:
        for seed in self.runs:
            status = self._status(seed)
            if status is None:
                continue
            for record in self._reader.metrics(status.run_id, after_iteration=self._shown[seed]):
                self._shown[seed] = int(record["iteration"] or 0)
                progress.show(record, f"seed {seed}")

    def _stop(self) -> None:
        self._stopping = True

    def _signal(self, number: int) -> None:
        for process in self._processes.values():
            process.send_signal(number)

    def _end_at_once(self) -> None:
        """End the runs that are left; each has a checkpoint at most an interval old."""
        for number, patience_s in ((SIGTERM, 1.0), (SIGTERM, GRACE_S), (SIGKILL, GRACE_S)):
            self._signal(number)
            deadline_s = time.monotonic() + patience_s
            while any(process.poll() is None for process in self._processes.values()):
                if time.monotonic() > deadline_s:
                    break
                time.sleep(POLL_S)
        for seed in list(self._processes):
            del self._processes[seed]
            self.runs[seed] = self._found(seed)
        self._save_if_possible()
