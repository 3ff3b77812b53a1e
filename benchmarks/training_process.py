"""A ``tandem pretrain`` in a process of its own, seen from outside as an operator sees it: pids, REST, files.

Only the command line and the files of a run are used, so the runs of other commits can be measured, too.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from tempfile import mkdtemp
from types import MappingProxyType
from typing import Any, Literal, Self, TypeVar

import psutil
from pydantic import ValidationError

from benchmarks.measuring import ROOT, Sample
from benchmarks.processes import cpu_s_by_role
from service.base.errors import StoreError, TandemError
from service.base.ports import free_port
from service.store.checkpoints import CheckpointStore
from service.store.disk_reader import DiskReader
from service.store.models import RunStatus
from service.store.run_directory import RunDirectory
from service.store.run_history import FILE as RUN_FILE

ENDLESS = {"run.total_env_steps": 1_000_000_000_000}
PLAIN = {"run.checkpoint_interval": 1_000_000_000, "run.evaluation_interval": 0}
"""Neither evaluations nor checkpoints."""
NAME = "run"
"""Of the run directory, below ``runs`` of its home."""
NUM_WARMUP_ITERATIONS = 4
"""After a start, before it is measured: by then the learner and all actors are busy."""
START_S = 240.0
"""Until the first iteration, on a machine that may be busy."""
STOP_S, LEFT_S = 60.0, 5.0
"""Until a run has ended, and then all that it started; what is left is killed."""
_LOOK_S = 0.005
_DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))
_Answer = TypeVar("_Answer")


class Training:
    """A run of its own on this machine; ends with the block. A run directory that is there already is resumed.

    Args:
        home: directory for its run, its registry and Ray's files; its path has to be short.
        arguments: of ``tandem pretrain``, besides runtime, run directory and status.
        runtime: which runner; ``ray`` has a status service.
        tree: checkout whose code runs.
        variables: further ones of its environment.
    """

    def __init__(
        self,
        home: Path,
        arguments: Sequence[str],
        *,
        runtime: Literal["local", "ray"] = "ray",
        tree: Path = ROOT,
        variables: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self.directory, self.log_file = RunDirectory(home / "runs" / NAME), home / f"{NAME}.log"
        address = f"127.0.0.1:{free_port('127.0.0.1')}"
        self._url = f"http://{address}/v1/runs/{NAME}"
        home.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "service", "pretrain", "--run-dir", str(self.directory.path)]
        command += ["--registry", str(home / "registry"), *(["--resume"] if self.directory.exists else [])]
        if runtime == "ray":
            command += ["--runtime", "ray", "--status", address]
        self.records = Records(self.directory.metrics_file)
        self._reader = DiskReader(self.directory.path.parent)
        with self.log_file.open("ab") as log:
            self._process = subprocess.Popen(
                [*command, *arguments],
                cwd=tree,
                env=environment(home, tree) | dict(variables),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        """Pid of the driver."""
        return self._process.pid

    @property
    def ended(self) -> int | None:
        """The exit code; None while it goes on."""
        return self._process.poll()

    def status(self) -> RunStatus | None:
        """The run's status by its status service, else as one for its directory has it; None before there is one."""
        try:
            with suppress(OSError, HTTPException), _DIRECT.open(self._url, timeout=2.0) as response:
                return RunStatus.model_validate_json(response.read())
            return self._reader.run(NAME)
        except (StoreError, ValidationError):
            return None

    def wait_for(self, what: Callable[[], _Answer | None], seconds: float = START_S) -> _Answer:
        """The first answer of ``what`` that is true."""
        deadline_s = time.monotonic() + seconds
        while self.ended is None and time.monotonic() < deadline_s:
            if answer := what():
                return answer
            time.sleep(_LOOK_S)
        why = f"not within {seconds:.0f} s" if self.ended is None else f"it ended with code {self.ended}"
        raise TandemError(f"the run does not do what is waited for: {why}; its last words: {self.last_words()}")

    def wait_until(self, key: str, value: float) -> None:
        """Wait, a day at most, until a record has at least ``value`` under ``key``."""
        self.wait_for(lambda: any(row[key] >= value for row in self.records.new()), 86_400.0)

    def stop(self) -> None:
        """End the run as ``ray job stop`` does: SIGTERM, which saves; what is left after a minute is killed."""
        if self.ended is None:
            below = psutil.Process(self.pid).children(recursive=True)
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            for left in psutil.wait_procs(below, LEFT_S)[1]:
                with suppress(psutil.NoSuchProcess):
                    left.kill()

    def last_words(self) -> str:
        """The last line of its log."""
        lines = self.log_file.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "none"


class Records:
    """Reads the records of a run as they are written.

    Args:
        file: ``metrics.jsonl``; what it holds already is passed over.
    """

    def __init__(self, file: Path) -> None:
        self._file, self._torn = file, b""
        self._offset = file.stat().st_size if file.exists() else 0

    def new(self) -> list[dict[str, Any]]:
        """The records written since the last call."""
        if not self._file.exists() or self._file.stat().st_size == self._offset:
            return []
        with self._file.open("rb") as file:
            file.seek(self._offset)
            added = file.read()
        self._offset += len(added)
        *lines, self._torn = (self._torn + added).split(b"\n")
        return [json.loads(line) for line in lines]


@dataclass(frozen=True, slots=True)
class Measured:
    """Some iterations of a run."""

    rows: Sequence[Mapping[str, float]]
    """Their records, and before them the last one that is not measured."""
    wall_s: float
    role_cpu_s: Mapping[str, float]
    """CPU seconds by role of process, several of one role together."""

    @property
    def sample(self) -> Sample:
        """Env steps and times."""
        num_steps = self.rows[-1]["env_steps"] - self.rows[0]["env_steps"]
        return Sample(int(num_steps), self.wall_s, sum(self.role_cpu_s.values()))


def measure_training(training: Training, num_iterations: int, num_actors: int = 1) -> Measured:
    """Measure about ``num_iterations`` iterations of a run that has just been started, then end it.

    It is measured from when ``num_actors`` are alive and ``NUM_WARMUP_ITERATIONS`` are over.
    """
    rows: list[dict[str, Any]] = []
    marks = []
    for num in (NUM_WARMUP_ITERATIONS, NUM_WARMUP_ITERATIONS + num_iterations):
        while len(rows) < num:
            for row in training.wait_for(training.records.new):
                # an actor that dies later is measured, too
                if rows or row.get("actor/num_alive", num_actors) >= num_actors:
                    rows.append(row)
        marks.append((len(rows), time.perf_counter(), cpu_s_by_role(training.pid)))
    training.stop()
    (num_before, first_s, before), (_, last_s, after) = marks
    role_cpu_s = {role: seconds - before.get(role, 0.0) for role, seconds in after.items()}
    return Measured(rows[num_before - 1 :], last_s - first_s, role_cpu_s)


def measure_copy(
    source: RunDirectory, home: Path, arguments: Sequence[str], num_iterations: int, num_actors: int = 1, **how: Any
) -> Measured:
    """Measure a run in a copy that goes on from its newest checkpoint and is deleted afterwards.

    ``home``, ``arguments`` and ``how`` are those of ``Training``, the numbers those of ``measure_training``.
    """
    copy = copy_run(source, home)
    with Training(home, arguments, **how) as training:
        measured = measure_training(training, num_iterations, num_actors)
    shutil.rmtree(copy.path)
    return measured


def environment(home: Path, tree: Path = ROOT) -> dict[str, str]:
    """Variables for a process with a Ray of its own: its files under ``home``, its own token, no other setting."""
    unset = ("RAY_ADDRESS", "TANDEM_REDIS_URL", "TANDEM_TOKEN", "TANDEM_RUNS", "TANDEM_REGISTRY")
    ray = {"RAY_TMPDIR": str(home), "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    kept = {name: value for name, value in os.environ.items() if name not in unset}
    return {**kept, **ray, "RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": str(tree)}


@contextmanager
def scratch() -> Iterator[Path]:
    """A directory with a short path, as Ray's sockets need, deleted at the end."""
    path = Path(mkdtemp(prefix="td-", dir="/tmp"))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def copy_run(source: RunDirectory, home: Path) -> RunDirectory:
    """Copy what a ``Training`` in ``home`` needs to go on from the newest checkpoint of ``source``."""
    store, target = CheckpointStore(source.checkpoints), RunDirectory(home / "runs" / NAME)
    if (newest := store.newest()) is None:
        raise TandemError(f"no run with a checkpoint in {source.path}; name one that has one")
    target.checkpoints.mkdir(parents=True)
    shutil.copy(newest, target.checkpoints)
    for file in (source.config_file, source.metrics_file, source.goals_file, source.path / RUN_FILE):
        if file.exists():
            shutil.copy(file, target.path)
    return target


def overrides(settings: Mapping[str, object]) -> list[str]:
    """``--set`` arguments of the command line."""
    return [part for key, value in settings.items() for part in ("--set", f"{key}={value}")]
