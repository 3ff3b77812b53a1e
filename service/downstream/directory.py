"""The directory of one downstream training.

| file | content |
|---|---|
| ``cell.json`` | settings of the trial, and which primitives (version and SHA-256 of their parameters) |
| ``metrics.jsonl`` | an object per iteration, keyed by metric; only ``time/...`` differs between equal runs |
| ``tensorboard/`` | the same metrics as TensorBoard events over env steps |
| ``checkpoints/`` | the newest one: everything the training continues from exactly, replay buffer included |
| ``result.json`` | how well it does in the end |
| ``policy.safetensors`` | what was learned, averaged; ``policy.load_policy`` plays it without torch |
| ``curves.png``, ``episodes.mp4`` | for people |
| ``tandem-error-*.txt`` | traceback of an error that nobody expected |
| ``.lock`` | held by the process that trains |
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from service.downstream.settings import TrialConfig, differences, validate
from service.errors import TRACEBACK_PREFIX, TandemError
from service.io.checkpoints import Checkpoint, CheckpointStore
from service.io.files import TEMPORARY_PREFIX, check_regular, os_errors, remove_temporaries, write_atomic
from service.io.jsonl import JsonlWriter
from service.io.lock import LOCK_FILE, DirectoryLock
from service.io.tensorboard import EventFile
from service.parsing import ParseError, parse_json
from service.regular_files import read_regular
from service.types import Arrays

FORMAT_VERSION = 1
"""Version of ``cell.json`` and ``result.json``, and of the table's files."""
TRIAL = "cell"
"""Key of a trial's settings in these files, which call a trial a cell."""
MAX_BYTES = 64 * 1024 * 1024
"""Of each of them, whose curves grow with the length of a training."""
_ELSEWHERE = "name another directory (--run-dir, of a table --runs)"


class TrainingDirectory:
    """Reads and writes the files of one training."""

    def __init__(self, path: Path) -> None:
        """Name the files; nothing is read or written before ``start``."""
        self.path = path
        self.trial_file = path / "cell.json"
        self.metrics_file = path / "metrics.jsonl"
        self._checkpoints = CheckpointStore(path / "checkpoints", keep=1)
        self.result_file = path / "result.json"
        self.policy_file = path / "policy.safetensors"
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
        self.check(identity, resume=resume)
        self._lock = DirectoryLock(self.path, f"stop that one first, or {_ELSEWHERE}")
        self.check(identity, resume=resume)  # of two that begin at once, the second sees here what the first has made
        saved = self._checkpoints.load_latest() if self._checkpoints.steps() else None
        with os_errors("write", self.path):
            remove_temporaries(self.path)
        write_json(self.trial_file, {"format_version": FORMAT_VERSION, **identity})  # first: it says whose the rest is
        check_regular(self.metrics_file)
        self._metrics.truncate_after(saved.step if saved else 0)
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


def made_with(tree: dict[str, Any]) -> dict[str, Any]:
    """Primitives and world in what was read from a file, as of ``methods.provenance``."""
    return {key: tree.get(key) for key in ("primitives", "world")}


def read_trial(tree: dict[str, Any], path: Path) -> TrialConfig:
    """The trial of what was read from a file; settings that are younger than the file have their defaults.

    Raises:
        TandemError: there is none, or its settings are no settings.
    """
    try:
        return validate(TrialConfig, tree.get(TRIAL))
    except TandemError as error:
        raise TandemError(f"{path}: {error}; name another directory") from None


def read_json(path: Path) -> dict[str, Any]:
    """Read the object in a file.

    Raises:
        TandemError: there is none, or it is of another format version.
    """
    with os_errors("read", path):
        data = read_regular(path, MAX_BYTES, follow=True)
    try:
        tree = dict(parse_json(data, path))
    except ParseError as error:
        raise TandemError(f"{path} is no JSON object: {error.reason}; remove it, or name another directory") from None
    except (ValueError, TypeError) as error:
        raise TandemError(f"{path} is no JSON object: {error}; remove it, or name another directory") from None
    _check_version(tree, path)
    return tree


class _Evaluation(BaseModel):
    success_last: float
    success_last_low: float
    success_last_high: float
    success_ever: float
    num_episodes: int


class _Point(BaseModel):
    env_steps: float
    success_last: float


class _Primitives(BaseModel):
    name: str
    env_steps: float | None = None


class _Made(BaseModel):
    git_commit: str | None


class _Result(BaseModel):
    """The parts of a result that commands and pages show; there are others."""

    model_config = ConfigDict(allow_inf_nan=False)
    evaluation: _Evaluation
    primitives: _Primitives | None
    made: _Made
    env_steps: float
    wall_s: float
    curve: list[_Point]


def read_result(path: Path) -> dict[str, Any]:
    """Read the result of a training.

    Raises:
        TandemError: as for ``read_json``; or it is no result.
    """
    tree = read_json(path)
    try:
        _Result.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise TandemError(f"{path} is no result: {where}: {first['msg']}; remove it, and it is made again") from None
    return tree


def _check_version(tree: dict[str, Any], path: Path) -> None:
    found = tree.get("format_version")
    if found != FORMAT_VERSION:
        raise TandemError(
            f"{path}: format version {found!r}, this program reads {FORMAT_VERSION}; name another directory"
        )


def write_json(path: Path, tree: dict[str, Any]) -> None:
    """Put an object into a file in one step.

    Raises:
        TandemError: the file cannot be written.
    """
    with os_errors("write", path):
        write_atomic(path, to_json(tree))


def to_json(tree: dict[str, Any]) -> bytes:
    """An object as the files have it."""
    return (json.dumps(tree, indent=1, allow_nan=False) + "\n").encode()
