"""Runs read from their directories, those of an older tandem, which has no ``status.json``, included."""

from __future__ import annotations

import json
import logging
import re
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from typing import Any

import yaml
from pydantic import ValidationError

from service.io.lock import is_locked
from service.store.disk import GOALS_FILE, STATUS_FILE, STOP_FILE
from service.store.errors import DamagedStoreError, StoreError, StoreUnavailableError, UnknownRunError
from service.store.models import ACTIVE, SILENT_AFTER, GoalGrid, Record, RunState, RunStatus
from service.store.tail import RecordFile

_logger = logging.getLogger(__name__)


def run_id_of(directory: Path) -> str:
    """A run's id on one machine: the name of its directory, with a dash for what an id may not hold."""
    name = re.sub(r"[^A-Za-z0-9._-]", "-", directory.resolve().name).lstrip("._-")[:128]
    return name or "run"


class DiskReader:
    """The ``RunReader`` of a directory of run directories; any number of threads may use it at once."""

    def __init__(self, root: Path) -> None:
        """Take the directory of run directories; nothing is read before the first call."""
        self.root = root
        self._runs: dict[Path, _RunFiles] = {}
        self._lock = Lock()

    def runs(self) -> list[RunStatus]:
        """All runs, newest start first."""
        statuses = [files.status(run_id) for run_id, files in self._list().items()]
        return sorted(statuses, key=lambda status: status.started, reverse=True)

    def run(self, run_id: str) -> RunStatus:
        """One run.

        Raises:
            UnknownRunError: there is no such run.
            StoreUnavailableError: the directory cannot be read.
        """
        return self._find(run_id).status(run_id)

    def metrics(self, run_id: str, *, after_iteration: int = 0) -> list[Record]:
        """The records of iterations above ``after_iteration``, in order; see `run` for errors."""
        return self._find(run_id).metrics(after_iteration)

    def goals(self, run_id: str) -> GoalGrid | None:
        """The newest grid; None before the first; see `run` for errors.

        Raises:
            DamagedStoreError: its file holds something else.
        """
        return self._find(run_id).goals()

    def request_stop(self, run_id: str) -> None:
        """Ask a run to end after its current iteration; nothing happens if it has ended; see `run` for errors.

        Raises:
            StoreError: a tandem runs it that takes no requests.
        """
        self._find(run_id).request_stop(run_id)

    def ready(self) -> None:
        """Return if the directory can be read.

        Raises:
            StoreUnavailableError: it cannot.
        """
        self._list()

    def _find(self, run_id: str) -> _RunFiles:
        runs = self._list()
        if run_id not in runs:
            raise UnknownRunError.of(run_id, self.root, sorted(runs))
        return runs[run_id]

    def _list(self) -> dict[str, _RunFiles]:
        try:
            found = sorted(path for path in self.root.iterdir() if _is_run(path))
        except OSError as error:
            raise StoreUnavailableError(
                f"cannot read the runs in {self.root}: {error.strerror}; name the directory that holds run directories"
            ) from error
        with self._lock:
            self._runs = {path: self._runs.get(path) or _RunFiles(path) for path in found}
            by_id: dict[str, _RunFiles] = {}
            for path, files in self._runs.items():
                by_id.setdefault(run_id_of(path), files)
            return by_id


def _is_run(path: Path) -> bool:
    return not path.name.startswith(".") and ((path / STATUS_FILE).is_file() or (path / "config.yaml").is_file())


class _RunFiles:
    """The files of one run."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._records = RecordFile(path / "metrics.jsonl")
        self._config: tuple[datetime, str | None, int | None] | None = None

    def status(self, run_id: str) -> RunStatus:
        try:
            status = RunStatus.model_validate_json((self.path / STATUS_FILE).read_bytes())
        except FileNotFoundError:
            return self._guess(run_id)
        except (OSError, ValidationError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is no run's status"
            note = f"{STATUS_FILE} cannot be read: {reason}; what is shown comes from metrics.jsonl"
            return self._guess(run_id).model_copy(update={"warnings": (note,)})
        if status.is_silent and not is_locked(self.path):
            status = status.vanished()
        stopping = status.state in ACTIVE and (status.stopping or (self.path / STOP_FILE).exists())
        return status.model_copy(update={"run_id": run_id, "stopping": stopping})  # a copied directory has another id

    def metrics(self, after_iteration: int) -> list[Record]:
        try:
            return self._records.after(after_iteration)
        except OSError as error:
            raise self._unavailable("metrics.jsonl", error) from error

    def goals(self) -> GoalGrid | None:
        path = self.path / GOALS_FILE
        try:
            return GoalGrid.model_validate_json(path.read_bytes())
        except FileNotFoundError:
            return None
        except OSError as error:
            raise self._unavailable(GOALS_FILE, error) from error
        except ValidationError:
            raise DamagedStoreError(f"{path} is no goal grid; delete it, a run writes it anew every few s") from None

    def request_stop(self, run_id: str) -> None:
        if self.status(run_id).state not in ACTIVE:
            return
        if not (self.path / STATUS_FILE).exists():
            raise StoreError(f"run {run_id} has no {STATUS_FILE}: an older tandem runs it; stop it with Ctrl-C there")
        try:
            (self.path / STOP_FILE).touch()
        except OSError as error:
            raise self._unavailable(STOP_FILE, error) from error

    def _unavailable(self, name: str, error: OSError) -> StoreUnavailableError:
        return StoreUnavailableError(
            f"cannot use {self.path / name}: {error.strerror}; check the disk and the permissions"
        )

    # --- without a status ---------------------------------------------------------------------------------------------

    def _guess(self, run_id: str) -> RunStatus:
        """The status as the configuration and the newest record show it."""
        started, heartbeat = self._time("config.yaml"), self._time("metrics.jsonl", "config.yaml")
        if self._config is None or self._config[0] != started:  # YAML takes its time
            self._config = (started, *self._read_config())
        _, name, total = self._config
        try:
            record = self._records.last() or {}
        except OSError:
            record = {}
        steps = _whole(record, "env_steps")
        return RunStatus(
            run_id=run_id,
            name=name or run_id,
            runtime="local",
            state=self._guess_state(steps, total, heartbeat),
            started=min(started, heartbeat),
            heartbeat=heartbeat,
            iteration=_whole(record, "iteration"),
            num_env_steps=steps,
            total_env_steps=total or max(1, steps),
            env_steps_per_s=_positive(record, "time/env_steps_per_s"),
            policy_version=_whole(record, "learner/version"),
            policy_lag=_positive(record, "learner/policy_lag"),
            num_rollouts_counted=max(0, _whole(record, "iteration") - 1),
            published=self._read_published(),
        )

    def _guess_state(self, steps: int, total: int | None, heartbeat: datetime) -> RunState:
        if total is not None and steps >= total:
            return "finished"
        if datetime.now(UTC) - heartbeat < SILENT_AFTER:
            return "running"
        published = self._time("published.json") >= heartbeat if (self.path / "published.json").exists() else False
        return "converged" if published else "interrupted"

    def _read_config(self) -> tuple[str | None, int | None]:
        """Name and budget, from a configuration of any version."""
        try:
            tree = yaml.safe_load((self.path / "config.yaml").read_bytes())
            return str(tree["name"]), max(1, int(tree["run"]["total_env_steps"]))
        except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError):
            return None, None

    def _read_published(self) -> str | None:
        try:
            note: Any = json.loads((self.path / "published.json").read_bytes())
            return str(note["version"])
        except (OSError, KeyError, TypeError, ValueError):
            return None

    def _time(self, *names: str) -> datetime:
        """Time at which the first of these files that exists was last written."""
        for name in names:
            try:
                return datetime.fromtimestamp((self.path / name).stat().st_mtime, UTC)
            except OSError:
                continue
        return datetime.fromtimestamp(0, UTC)


def _whole(record: Record, name: str) -> int:
    return int(_positive(record, name))


def _positive(record: Record, name: str) -> float:
    return max(0.0, record.get(name) or 0.0)
