"""The directory of one downstream training.

| file | content |
|---|---|
| ``cell.json`` | settings of the trial, and which primitives (version and SHA-256 of their parameters) |
| ``metrics.jsonl`` | an object per iteration, keyed by metric; only ``time/...`` differs between equal runs |
| ``tensorboard/`` | the same metrics as TensorBoard events over env steps |
| ``checkpoints/`` | the newest one: everything the training continues from exactly, replay buffer included |
| ``result.json`` | how well it does in the end |
| ``policy.safetensors`` | what was learned, averaged; ``service.load`` of the directory plays it without torch |
| ``published.json`` | the version that it was published as last, and the sha256 of its parameters |
| ``curves.png``, ``episodes.mp4`` | for people |
| ``tandem-error-*.txt`` | traceback of an error that nobody expected |
| ``.lock`` | held by the process that trains |
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

from service.downstream.files import (
    FORMAT_VERSION,
    RESULT_FILE,
    TRIAL,
    made_with,
    read_json,
    write_json,
)
from service.downstream.settings import TrialConfig, differences, validate
from service.errors import TRACEBACK_PREFIX, TandemError
from service.io.checkpoints import Checkpoint, CheckpointStore
from service.io.files import TEMPORARY_PREFIX, os_errors, remove_temporaries
from service.io.jsonl import JsonlWriter
from service.io.lock import LOCK_FILE, DirectoryLock
from service.io.run_directory import TRIAL_FILE
from service.primitives.learned import POLICY_FILE
from service.types import Arrays

_ELSEWHERE = "name another directory (--run-dir, of a table --runs)"


class TrainingDirectory:
    """Reads and writes the files of one training."""

    def __init__(self, path: Path) -> None:
        """Name the files; nothing is read or written before ``start``."""
        self.path = path
        self.trial_file = path / TRIAL_FILE
        self.metrics_file = path / "metrics.jsonl"
        self._checkpoints = CheckpointStore(path / "checkpoints", keep=1)
        self.result_file = path / RESULT_FILE
        self.policy_file = path / POLICY_FILE
        self._metrics = JsonlWriter(self.metrics_file)
        self._lock: DirectoryLock | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._metrics.sync()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def start(self, identity: dict[str, Any], *, resume: bool) -> Checkpoint | None:
        """Begin a training here, or continue one, and keep other processes out until the ``with`` block ends.

        Args:
            identity: settings and primitives, as JSON has them.
            resume: continue what is here; where nothing is, begin.

        Returns:
            The checkpoint to continue from; None for a beginning.

        Raises:
            TandemError: a training is here already and is not to be resumed, or is another one; another process is at
                it; or the directory cannot be read or written.
        """
        from service.io.tensorboard import EventFile  # TensorBoard's packages, which only a training needs

        self.check(identity, resume=resume)
        self._lock = DirectoryLock(self.path, f"stop that one first, or {_ELSEWHERE}")
        self.check(identity, resume=resume)  # of two that begin at once, the second sees here what the first has made
        saved = self._checkpoints.load_latest() if self._checkpoints.steps() else None
        with os_errors("write", self.path):
            remove_temporaries(self.path)
        write_json(self.trial_file, {"format_version": FORMAT_VERSION, **identity})  # first: it says whose the rest is
        self._metrics.cut_after(saved.step if saved else 0)
        with os_errors("write", self.path):
            self._events = EventFile(self.path / "tensorboard", after_step=saved.meta["env_steps"] if saved else None)
        return saved

    def check(self, identity: dict[str, Any], *, resume: bool) -> None:
        """Assert that this training can begin, or continue, here.

        Raises:
            TandemError: it cannot; nothing was written.
        """
        if not self.trial_file.exists():
            with os_errors("read", self.path):
                names = [file.name for file in self.path.iterdir()] if self.path.exists() else []
            # a process that ended before it wrote its first file leaves a lock, temporary files, or a traceback
            if any(name != LOCK_FILE and not name.startswith((TEMPORARY_PREFIX, TRACEBACK_PREFIX)) for name in names):
                raise TandemError(f"{self.path} holds something else than a downstream training; {_ELSEWHERE}")
            return
        if not resume:
            raise TandemError(f"{self.path} holds a training already; continue it with --resume, or {_ELSEWHERE}")
        recorded = read_json(self.trial_file)
        trial = read_trial(recorded, self.trial_file).model_dump(mode="json")
        if wrong := differences(trial | made_with(recorded), identity[TRIAL] | made_with(identity)):
            raise TandemError(f"{self.path} was begun with {'; '.join(wrong)}; {_ELSEWHERE}")

    def record(self, metrics: dict[str, float]) -> None:
        """Append one iteration's metrics to metrics.jsonl and TensorBoard."""
        self._metrics.append(metrics)
        self._events.add(metrics)

    def save(self, iteration: int, arrays: Arrays, meta: dict[str, Any]) -> None:
        """Write a checkpoint, then delete the one before; the records it knows of are on the disk first.

        Raises:
            CheckpointError: the disk is full; the last checkpoint is as it was.
        """
        self._metrics.sync()
        self._checkpoints.save(iteration, arrays, meta)


def read_trial(tree: dict[str, Any], path: Path) -> TrialConfig:
    """The trial of what was read from a file; settings that are younger than the file have their defaults.

    Raises:
        TandemError: there is none, or its settings are no settings.
    """
    try:
        return validate(TrialConfig, tree.get(TRIAL))
    except TandemError as error:
        raise TandemError(f"{path}: {error}; name another directory") from None
