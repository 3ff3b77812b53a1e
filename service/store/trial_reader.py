"""Downstream trainings as runs: the status of a directory that ``tandem downstream train`` has written.

Nothing writes ``status.json`` there: what is known comes from the settings, the newest record, the result and the lock.
"""

from __future__ import annotations

import os
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

from service.downstream.files import RESULT_FILE, TRIAL, read_json, read_result
from service.errors import TRACEBACK_PREFIX, TandemError
from service.io.lock import is_locked
from service.io.run_directory import TRIAL_FILE
from service.store.disk import read_published
from service.store.models import RunState, RunStatus, Trial
from service.store.tail import RecordFile

_MAX_TEXT = 500
"""Characters of a name."""


def is_trial(path: Path) -> bool:
    """Whether a directory is that of a downstream training."""
    return os.path.isfile(path / TRIAL_FILE)


def read_trial_status(run_id: str, path: Path, records: RecordFile) -> RunStatus:
    """The status of a training; where a file is damaged, without what it says, and with a warning."""
    settings, warnings = _settings(path)
    result = None
    try:
        result = read_trial_result(path)
    except TandemError as error:
        warnings = (*warnings, str(error))
    try:
        record = records.last() or {}
    except OSError:
        record = {}
    started = modified(path / TRIAL_FILE)
    heard = max(started, modified(path / "metrics.jsonl"), modified(path / RESULT_FILE))
    steps = max(0, int(float(result["env_steps"] if result is not None else record.get("env_steps") or 0)))
    state: RunState
    state, last_error = ("finished", None) if result is not None else _unfinished(path, started)
    trial = _trial(settings, result)
    return RunStatus(
        run_id=run_id,
        name=f"{trial.task}-{trial.method}-{trial.seed}" if trial is not None else run_id,
        trial=trial,
        runtime="local",
        state=state,
        started=started,
        heartbeat=heard,
        iteration=int(record.get("iteration") or 0),
        num_env_steps=steps,
        total_env_steps=max(1, steps if result is not None else _whole(settings.get(TRIAL, {}).get("num_env_steps"))),
        env_steps_per_s=max(0.0, record.get("time/env_steps_per_s") or 0.0),
        published=read_published(path),
        last_error=last_error,
        warnings=warnings,
    )


def read_trial_settings(path: Path) -> dict[str, Any]:
    """What ``cell.json`` has: settings under ``TRIAL``, ``primitives`` and ``world``.

    Raises:
        TandemError: there is none, or it is damaged.
    """
    file = path / TRIAL_FILE
    return _read(read_json, file, _stamp(file))


def read_trial_result(path: Path) -> dict[str, Any] | None:
    """What ``result.json`` has; None where the training has not ended.

    Raises:
        TandemError: it is damaged.
    """
    file = path / RESULT_FILE
    stamp = _stamp(file)
    return None if stamp is None else _read(read_result, file, stamp)


@lru_cache(maxsize=1024)
def _read(reader: Any, file: Path, stamp: object) -> dict[str, Any]:
    found: dict[str, Any] = reader(file)
    return found


def _stamp(file: Path) -> tuple[int, int, int] | None:
    """What changes with a file; None where there is none."""
    try:
        status = file.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def _settings(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    try:
        tree = read_trial_settings(path)
    except TandemError as error:
        return {}, (str(error),)
    if isinstance(tree.get(TRIAL), dict):
        return tree, ()
    return {}, (f"{path / TRIAL_FILE} has no settings of a training; remove the directory, or train in another",)


def _trial(settings: dict[str, Any], result: dict[str, Any] | None) -> Trial | None:
    trial, made_with = settings.get(TRIAL), settings.get("primitives")
    if trial is None:
        return None
    primitives = made_with if isinstance(made_with, dict) else {}
    digest = primitives.get("digest")
    evaluation = result["evaluation"] if result is not None else {}
    return Trial(
        task=_text(trial.get("task")),
        method=_text(trial.get("method")),
        seed=_whole(trial.get("seed")),
        primitives=_text(primitives["name"]) if "name" in primitives else None,
        primitives_digest=_text(digest) if digest is not None else None,
        success=evaluation.get("success_last"),
        success_low=evaluation.get("success_last_low"),
        success_high=evaluation.get("success_last_high"),
        success_ever=evaluation.get("success_ever"),
        num_episodes=evaluation.get("num_episodes"),
    )


def _unfinished(path: Path, started: datetime) -> tuple[RunState, str | None]:
    if is_locked(path):
        return "running", None
    traceback = max(path.glob(f"{TRACEBACK_PREFIX}*"), key=modified, default=None)
    if traceback is not None and modified(traceback) >= started:
        return "failed", f"an error that nobody expected; {traceback} has its traceback"
    return "interrupted", None


def modified(path: Path) -> datetime:
    """Time at which a file, or what a link leads to, was last written; 1970 where that cannot be told."""
    try:
        return datetime.fromtimestamp(path.stat().st_mtime, UTC)
    except OSError:
        return datetime.fromtimestamp(0, UTC)


def _text(value: object) -> str:
    return value[:_MAX_TEXT] if isinstance(value, str) else "?"


def _whole(value: object) -> int:
    return max(0, value) if isinstance(value, int) else 0
