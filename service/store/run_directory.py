"""A run directory: everything a run leaves behind, and nothing else.

| file | content |
|---|---|
| ``config.yaml`` | the resolved configuration |
| ``environment.json`` | git commit, package versions and cores of the last start |
| ``run.json`` | the run's identity, and of each start what had changed and which records were damaged |
| ``epochs/`` | a file for each process that ever ran it; the highest number is who runs it now |
| ``metrics.jsonl`` | an object per iteration, keyed by metric; only ``time/...`` differs between equal runs |
| ``goals.jsonl`` | per iteration a sample of goals: starts, goals (x y z of each object, metres), solved 0/1 |
| ``tensorboard/`` | the same metrics as TensorBoard events over env steps |
| ``checkpoints/`` | the newest checkpoints; ``--resume`` continues from them exactly |
| ``snapshots/`` | Bob's parameters untrained and after each tenth of the run, kept for good |
| ``result.json`` | what was measured when learning was over |
| ``published.json`` | the version this run published last, and the sha256 of its parameters |
| ``recordings/`` | earlier videos, with the time at which a newer one took their place |
| ``log.jsonl`` | what happened: who died, who came back, how it ended; see ``service.store.run_log`` |
| ``broken/`` | states of worlds whose physics diverged |
| ``status.json``, ``goals.json``, ``stop`` | the run's state while it goes on; see ``service.store.models`` |
| ``tandem-error-*.txt`` | traceback of an unexpected error |
| ``.lock`` | held by the process that runs it |
"""

from __future__ import annotations

import io
import json
import logging
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, JsonValue, TypeAdapter

from service.base.errors import TRACEBACK_PREFIX, CheckpointError, ConfigError, RunTakenError, StorageError, TandemError
from service.base.files import Appender, os_errors, remove_temporaries, write_atomic
from service.base.jsonl import JsonlWriter
from service.base.lock import EPOCHS, LOCK_FILE, DirectoryLock, claim_epoch, give_back_epoch, newest_epoch
from service.base.parsing import parse_json
from service.base.types import FloatArray, StateArray
from service.base.version import LEARNING_VERSION, git_commit
from service.config import Config, dump_config, load_config
from service.store import run_log
from service.store.checkpoints import CheckpointStore
from service.store.models import CONFIG_FILE, GOALS_FILE, METRICS_FILE, OUTPUT_FILE, STATUS_FILE, STOP_FILE, STUDY_FILE
from service.store.run_history import (
    BEFORE,
    Event,
    RunHistory,
    is_of_this_version,
    of_another_version,
    read_history,
    read_note,
)

if TYPE_CHECKING:
    from service.base.tensorboard import EventFile

_logger = logging.getLogger(__name__)
MAX_DIVERGED_FILES = 100
RECORDINGS = "recordings"
RESULT_FILE = "result.json"
"""What was measured at the end of a run."""
_BEFORE_A_RUN = (
    ".",
    TRACEBACK_PREFIX,
    OUTPUT_FILE,
    STATUS_FILE,
    run_log.FILE,
    "run.json",
    "environment.json",
    "tensorboard",
    "checkpoints",
    "snapshots",
    EPOCHS,
    STOP_FILE,
)
"""How names begin of what may be where a run begins: one that ended before it had begun leaves it."""
MAX_RECORDINGS = 20


class _Result(BaseModel):
    """What ``result.json`` has to have."""

    evaluation: dict[str, float]
    env_steps: int
    wall_s: float


class Published(NamedTuple):
    """A version that a run published."""

    version: str
    """``NAME@VERSION``."""
    blob_sha256: str
    """Digest of its parameters: another registry may have another version of that number."""


@dataclass(frozen=True, slots=True)
class Resumption:
    """The checkpoint that a run goes on from, as far as its directory has to know."""

    iteration: int
    num_env_steps: int
    run: str
    """Identity of the run that saved it."""
    changed: dict[str, tuple[JsonValue, JsonValue]]
    """Settings that are not as they were then: what they were, and what they are."""


class RunDirectory:
    """Reads and writes the files of one run.

    A process that runs it calls ``claim``, then ``start``, and ``close`` at the end. Nothing is written before.

    Args:
        path: of the directory.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config_file = path / CONFIG_FILE
        self.metrics_file = path / METRICS_FILE
        self.goals_file = path / GOALS_FILE
        self.checkpoints = path / "checkpoints"
        self.snapshots = path / "snapshots"
        self.published_file = path / "published.json"
        self.diverged = path / "broken"
        self._metrics = JsonlWriter(self.metrics_file)
        self._goals = JsonlWriter(self.goals_file)
        self._events: EventFile | None = None
        self._failing: dict[Path, str] = {}
        self._lock: DirectoryLock | None = None
        self.history = RunHistory.new()
        """Identity of the run, and what was not as before when a process went on with it; read by ``claim``."""
        self.epoch = 0
        """Number of this process among those that ever ran the run; 0 before ``claim``."""

    @property
    def exists(self) -> bool:
        """Whether a run has begun here."""
        return self.config_file.exists()

    def read_config(self, overrides: list[str] | tuple[str, ...] = ()) -> Config:
        """Read the run's resolved configuration, with ``overrides`` as in ``load_config``.

        Raises:
            ConfigError: no run here, one of another version, or its configuration cannot be read.
            StorageError: the file that names its version cannot be read, or is damaged.
        """
        if not self.exists:
            raise ConfigError(f"no run in {self.path}: {self.config_file.name} is missing; name the directory of a run")
        history = read_history(self.path)
        version = history.tandem if history is not None else BEFORE
        if not is_of_this_version(version):
            raise ConfigError(of_another_version(self.path, version))
        return load_config(self.config_file, overrides)

    def start(self, config: Config, resumption: Resumption | None = None) -> None:
        """Begin a run here, or continue one: then records of later iterations, which will be made again, are dropped.

        Args:
            config: the run.
            resumption: where it goes on; None for a run that begins.

        Raises:
            StorageError: the directory cannot be read or written.
        """
        from service.base.tensorboard import EventFile  # TensorBoard's packages, which only a run needs

        with os_errors("write", self.path):
            self.checkpoints.mkdir(parents=True, exist_ok=True)
            remove_temporaries(self.path)
        lost = self._cut_records(resumption.iteration if resumption is not None else 0)
        after_step = resumption.num_env_steps if resumption is not None else None
        self._events = EventFile(self.path / "tensorboard", after_step=after_step)
        if resumption is not None and (resumption.changed or lost):
            event = Event(
                at=datetime.now(UTC),
                after_iteration=resumption.iteration,
                changed=resumption.changed,
                damaged_records=lost,
            )
            self.history = self.history.model_copy(update={"events": (*self.history.events, event)})
        self.history.write(self.path)
        write_atomic(self.path / "environment.json", json.dumps(_environment(), indent=1).encode())
        write_atomic(self.config_file, dump_config(config).encode())  # last: a start that failed can be tried again

    def read_published(self) -> Published | None:
        """What this run published last; None before the first.

        Raises:
            StorageError: the file that says so cannot be read, or is damaged.
        """
        return read_note(self.published_file, TypeAdapter(Published).validate_json)

    def read_result(self) -> dict[str, Any] | None:
        """What was measured at the end; None before it.

        Raises:
            StorageError: the file that says so cannot be read, or is damaged.
        """

        def parse(data: bytes) -> dict[str, Any]:
            result: dict[str, Any] = parse_json(data, RESULT_FILE)
            _Result.model_validate(result)
            return result

        return read_note(self.path / RESULT_FILE, parse)

    def write_result(self, result: Mapping[str, JsonValue]) -> None:
        """Keep what was measured at the end, in ``result.json``.

        Raises:
            StorageError: it cannot be written.
        """
        write_atomic(self.path / RESULT_FILE, encode_result(result))

    def write_published(self, published: Published) -> None:
        """Note what this run published.

        Raises:
            StorageError: it cannot be written.
        """
        write_atomic(self.published_file, json.dumps(published._asdict()).encode())

    def claim(self, *, resume: bool) -> None:
        """Keep every other process from running this run until ``close``; a second call does nothing.

        Raises:
            TandemError: another process runs it; or a new run where there is one already.
            CheckpointError: ``resume`` where there is no checkpoint. Then, as always, nothing was written.
        """
        if self._lock is not None:
            return
        if resume:
            CheckpointStore(self.checkpoints).check_any()
        else:
            self._check_free()
        self._lock = DirectoryLock(self.path)
        if not resume:
            self._check_free()  # of two that begin at once, the second sees here what the first has made
        self.history = (read_history(self.path) if resume else None) or self.history
        self.epoch = claim_epoch(self.path)

    def check_owner(self) -> None:
        """Assert that no other process has taken over the run since ``claim``.

        Raises:
            RunTakenError: one has; this one must write nothing more.
        """
        if newest_epoch(self.path) > self.epoch > 0:
            raise RunTakenError(
                f"{self.path} was taken over by another process; this one stops, and what it did since then is not kept"
            )

    def check_resumable(self, resumption: Resumption) -> None:
        """Check that a checkpoint is of this run.

        Raises:
            CheckpointError: it is of another run.
        """
        if self.history.run != resumption.run:
            raise CheckpointError(
                f"{self.path}: its newest checkpoint is of another run ({resumption.run[:8]}, not "
                f"{self.history.run[:8]}); put that of this run back"
            )

    def _cut_records(self, iteration: int) -> tuple[str, ...]:
        """Keep the records up to an iteration, and say what is lost of them that was not lost before."""
        known = {text for event in self.history.events for text in event.damaged_records}
        lost = []
        for writer in (self._metrics, self._goals):
            num_kept, num_strange = writer.cut_after(iteration)
            if num_strange:
                lost.append(f"{writer.path.name}: lines that were no records: {num_strange}")
            if writer is self._metrics and num_kept < iteration:  # of goals not every iteration has some
                text = f"{writer.path.name}: iterations that it lacks: {iteration - num_kept}"
                lost += [text] * (text not in known)
        for text in lost:
            _logger.warning("%s: %s; the run goes on without them", self.path, text)
        return tuple(lost)

    def _check_free(self) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise TandemError(f"{self.path} is no directory; name another --run-dir")
        if self.exists:
            raise TandemError(f"{self.path} holds a run already; continue it with --resume, or name another --run-dir")
        if (self.path / STUDY_FILE).is_file():
            raise TandemError(f"{self.path} holds a study; name another --run-dir")
        if self.path.exists() and not (self.path / LOCK_FILE).exists():  # which is left by one that was killed
            with os_errors("read", self.path):
                others = sorted(each.name for each in self.path.iterdir() if not each.name.startswith(_BEFORE_A_RUN))
            if others:
                raise TandemError(f"{self.path} holds no run, but {others[0]!r}; name another --run-dir")

    def record(self, metrics: dict[str, float]) -> None:
        """Append one iteration's metrics to metrics.jsonl and TensorBoard; where a disk is full they wait in memory."""
        with self.keep_running(self.metrics_file):
            self._metrics.append(metrics)
        if self._events is not None:
            with self.keep_running(self._events.path):
                self._events.add(metrics)

    def record_goals(self, iteration: int, num_env_steps: int, goals: StateArray) -> None:
        """Append a sample of an iteration's goals, see ``Iteration``."""
        with self.keep_running(self.goals_file):
            self._goals.append({"iteration": iteration, "env_steps": num_env_steps, "goals": np.round(goals, 4)})

    def keep_recording(self, path: Path) -> None:
        """Put a video aside that is about to be replaced; of more than twenty, the oldest go."""
        kept_in = self.path / RECORDINGS
        with self.keep_running(kept_in), os_errors("write", kept_in), suppress(FileNotFoundError):
            when = datetime.fromtimestamp(path.stat().st_mtime, UTC).strftime("%Y%m%dT%H%M%S")
            kept_in.mkdir(exist_ok=True)
            path.replace(kept_in / f"{path.stem}-{when}{path.suffix}")
            kept = sorted(kept_in.glob(f"{path.stem}-*{path.suffix}"))
            for old in kept[:-MAX_RECORDINGS]:
                old.unlink(missing_ok=True)

    def dump_diverged(self, name: str, diverged: Sequence[tuple[StateArray, FloatArray]]) -> None:
        """Save the (state, action) pairs of a round whose physics diverged, under the round's name, for 100 rounds."""
        if not diverged:
            return
        states, actions = zip(*diverged, strict=True)
        path, data = self.diverged / f"round-{name}.npz", io.BytesIO()
        with self.keep_running(self.diverged), os_errors("write", self.diverged):
            self.diverged.mkdir(exist_ok=True)
            if len(list(self.diverged.iterdir())) >= MAX_DIVERGED_FILES:
                return
            _logger.warning("physics diverged in %d worlds, which go on from sound states; see %s", len(states), path)
            np.savez(data, states=np.stack(states), actions=np.stack(actions))
            write_atomic(path, data.getvalue())

    def sync(self) -> None:
        """Wait until the disk has every record: a checkpoint must not be ahead of them."""
        for writer in self._writers():
            with self.keep_running(writer.path):
                writer.sync()

    def close(self) -> None:
        """Write what still waits for room on the disk, and let other processes in.

        What does not fit is lost, and a warning says so.
        """
        for writer in self._writers():
            try:
                writer.sync()
            except StorageError as error:  # must not hide why the run ended
                _logger.warning("the newest records are lost: %s", error)
        if self._lock is not None:
            if self._events is None:  # it did not start
                give_back_epoch(self.path, self.epoch)
            try:
                begun = self.exists
            except OSError:  # the directory may not be read: nothing of it is removed
                begun = True
            self._lock.release(begun=begun)
            self._lock = None
            self.epoch = 0
        self._events = None

    def _writers(self) -> list[Appender]:
        return [self._metrics, self._goals, *([self._events] if self._events is not None else [])]

    def problems(self) -> list[str]:
        """Why records, reports or checkpoints cannot be written at the moment; empty when all is well."""
        minor = self.diverged, self.path / RECORDINGS
        return [problem for path, problem in list(self._failing.items()) if path not in minor]

    @contextmanager
    def noting(self, path: Path) -> Iterator[None]:
        """Keep among the `problems` why ``path`` cannot be written, until it can be again."""
        try:
            yield
        except StorageError as error:
            self._failing[path] = str(error)
            raise
        self._failing.pop(path, None)

    @contextmanager
    def keep_running(self, path: Path) -> Iterator[None]:
        """Turn a full disk into one warning for ``path`` until a write succeeds again: the run does not end for it."""
        known = path in self._failing
        try:
            with self.noting(path):
                yield
        except StorageError as error:
            if not known:
                _logger.warning("%s; the run goes on", error)


def encode_result(result: Mapping[str, JsonValue]) -> bytes:
    """A result as JSON, with what it was made by."""
    made = {"git_commit": git_commit(), "learning_version": LEARNING_VERSION, "num_cores": os.cpu_count()}
    return (json.dumps({**result, "made": made}, indent=1) + "\n").encode()


def _environment() -> dict[str, object]:
    return {
        "git_commit": git_commit(),
        "python": platform.python_version(),
        "packages": {name: version(name) for name in ("mujoco", "numpy", "torch")},
        "num_cores": os.cpu_count(),
    }
