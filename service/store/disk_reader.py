"""Runs read from their directories."""

from __future__ import annotations

import os
import re
import shutil
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock

from service.base.epoch import newest_epoch
from service.base.errors import DamagedStoreError, StoreUnavailableError, UnknownRunError, one_line
from service.base.lock import holder, is_locked
from service.base.parsing import ParseError, parse_with
from service.base.regular_files import read_regular
from service.store.disk import GOALS_FILE, MAX_BYTES, STATUS_FILE, STOP_FILE, STUDY_FILE
from service.store.models import ACTIVE, Columns, GoalGrid, Record, RunStatus
from service.store.pulse import Pulse, with_clock
from service.store.run_history import FILE as RUN_FILE
from service.store.run_history import FIRST_VERSION, written_by
from service.store.tail import RecordFile

QUIET_S = 10.0
"""A run writes its status every second; after so long something keeps it from that."""
MAX_COLUMN_BYTES = 256 * 1024 * 1024
"""Of metrics in memory: all 70 of 45 runs with 10,000 iterations each."""
FULL_BYTES = 1_000_000
"""A disk with less room than this is full: a status and a grid would not fit."""


def is_study(path: Path) -> bool:
    """Whether a study has begun in this directory."""
    return os.path.isfile(path / STUDY_FILE)


def run_id_of(directory: Path) -> str:
    """A run's id on one machine: the name of its directory, with a dash for what an id may not hold.

    That of a study's run begins with the name of the study.
    """
    path = _real(directory)
    name = f"{path.parent.name[: 127 - len(path.name[:100])]}-{path.name}" if is_study(path.parent) else path.name
    return re.sub(r"[^A-Za-z0-9._-]", "-", name).lstrip("._-")[:128] or "run"


def study_of(directory: Path) -> str | None:
    """The name of the study whose run this is; None for a run of its own."""
    parent = _real(directory).parent
    return parent.name if is_study(parent) else None


def run_directories(root: Path) -> dict[str, Path]:
    """The run directories in ``root`` by the ids of their runs, and those of studies.

    Of two directories with the same id, the first is found.

    Raises:
        OSError: ``root`` cannot be read.
    """
    found, inner = sorted(root.iterdir()), list[Path]()
    for path in found:
        if path.name.startswith(".") or _is_run(path):
            continue
        with suppress(OSError):
            if is_study(path):
                inner += filter(_is_run, sorted(path.iterdir()))
    return {run_id_of(path): path for path in reversed([*filter(_is_run, found), *inner])}


class DiskReader:
    """The ``RunReader``, which see for errors, of a directory of run directories; for any number of threads at once."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._records: dict[Path, RecordFile] = {}
        self._found: dict[str, tuple[Path, RecordFile]] = {}
        """Of the last listing."""
        self._in_columns: dict[RecordFile, None] = {}
        """Those with columns in memory, the one that was asked for last at the end."""
        self._pulse = Pulse()
        self._lock = Lock()

    def runs(self) -> list[RunStatus]:
        """All runs, newest start first."""
        statuses = [self._status(run_id, path, records) for run_id, (path, records) in self._list().items()]
        return sorted(statuses, key=lambda status: status.started, reverse=True)

    def run(self, run_id: str) -> RunStatus:
        """One run."""
        return self._status(run_id, *self._find(run_id))

    def metrics(self, run_id: str, *, after_iteration: int = 0) -> list[Record]:
        """The records of iterations above ``after_iteration``, in order."""
        path, records = self._find(run_id)
        with _using(path / "metrics.jsonl"):
            return records.after(after_iteration)

    def columns(self, run_id: str, names: Sequence[str] | None) -> Columns:
        """These metrics of all iterations; what was read stays in memory, up to ``MAX_COLUMN_BYTES`` of all runs."""
        path, records = self._find(run_id)
        with _using(path / "metrics.jsonl"):
            found = records.columns(names)
        with self._lock:
            self._in_columns.pop(records, None)
            self._in_columns[records] = None
            kept, num_bytes = list(self._in_columns), sum(each.num_bytes for each in self._in_columns)
            while num_bytes > MAX_COLUMN_BYTES and len(kept) > 1:
                oldest = kept.pop(0)
                num_bytes -= oldest.num_bytes
                del self._in_columns[oldest]
                oldest.forget()
        return found

    def sample(self, run_id: str, name: str, number: int) -> list[float | None]:
        """One metric of about ``number`` records, evenly over the file."""
        path, records = self._find(run_id)
        with _using(path / "metrics.jsonl"):
            return records.sample(name, number)

    def goals(self, run_id: str) -> GoalGrid | None:
        """The newest grid; None before the first."""
        path = self._find(run_id)[0] / GOALS_FILE
        with _using(path):
            try:
                return parse_with(GoalGrid.model_validate_json, read_regular(path, MAX_BYTES), path)
            except FileNotFoundError:
                return None
            except ParseError:
                raise DamagedStoreError(
                    f"{path} is no goal grid; delete it, a run writes it anew every few s"
                ) from None

    def request_stop(self, run_id: str) -> None:
        """Ask a run to end after its current iteration; nothing happens if it has ended."""
        path, records = self._find(run_id)
        if self._status(run_id, path, records).state not in ACTIVE:
            return
        with _using(path / STOP_FILE):
            (path / STOP_FILE).touch()

    def ready(self) -> None:
        """Return if the directory can be read."""
        self._list()

    def _status(self, run_id: str, path: Path, records: RecordFile) -> RunStatus:
        try:
            if (cause := _why_closed(path)) is not None:
                return _unreadable(run_id, path, cause)
            status = self._read_status(run_id, path, records)
        except Exception as error:  # whatever a directory holds, it must not hide the other runs
            return _unreadable(run_id, path, f"{type(error).__name__}: {error}")
        if (number := records.num_passed_over) > 0:
            status = status.suffering("well", f"metrics.jsonl: lines that are no records and are passed over: {number}")
        return status

    def _read_status(self, run_id: str, path: Path, records: RecordFile) -> RunStatus:
        status = _read_status(run_id, path)
        age_s = self._pulse.age_s(run_id, status.heartbeat)
        status = with_clock(status)
        if status.state not in ACTIVE or age_s <= QUIET_S:
            return status
        silent = status.is_silent(age_s)
        if not is_locked(path):
            return status.vanished() if silent else status
        return _why_quiet(status, path) or (_why_silent(status, path, age_s) if silent else status)

    def _find(self, run_id: str) -> tuple[Path, RecordFile]:
        known = self._found.get(run_id)
        if known is not None and _is_run(known[0]):  # many clients ask for a few runs, again and again
            return known
        runs = self._list()
        if run_id not in runs:
            raise UnknownRunError.of(run_id, self.root, sorted(runs))
        return runs[run_id]

    def _list(self) -> dict[str, tuple[Path, RecordFile]]:
        """Directory and records of each run, by its id."""
        try:
            found = run_directories(self.root)
        except OSError as error:
            raise StoreUnavailableError(
                f"cannot read the runs in {self.root}: {error.strerror}; name the directory that holds run directories"
            ) from error
        with self._lock:
            known = self._records
            self._records = {path: known.get(path) or RecordFile(path / "metrics.jsonl") for path in found.values()}
            there = set(self._records.values())
            self._in_columns = {each: None for each in self._in_columns if each in there}
            self._found = {run_id: (path, self._records[path]) for run_id, path in found.items()}
            return self._found


def _is_run(path: Path) -> bool:
    """Whether it is a run's directory, or one that cannot be looked into, which may be a run's."""
    if path.name.startswith(".") or path.name == "lost+found":  # the latter is of the file system
        return False
    files = (path / STATUS_FILE, path / "config.yaml")
    return any(map(os.path.isfile, files)) or _why_closed(path) is not None


def _why_closed(path: Path) -> str | None:
    """Why a directory cannot be looked into, such as a loop of links; None where it can, or is none."""
    try:
        os.stat(f"{path}/.")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        return error.strerror
    return None


def _real(path: Path) -> Path:
    """A path without links; of a loop of links, which ``Path.resolve`` does not survive, some path in it."""
    return Path(os.path.realpath(path))


def _unreadable(run_id: str, path: Path, cause: str) -> RunStatus:
    return _damaged(run_id, path, f"{path} cannot be read: {one_line(cause, 300)}; mend it, or remove it")


def _damaged(run_id: str, path: Path, cause: str) -> RunStatus:
    """The status of a directory of which nothing can be said but why."""
    try:
        changed = datetime.fromtimestamp(path.lstat().st_mtime, UTC)
    except OSError:
        changed = datetime.fromtimestamp(0, UTC)
    return RunStatus(
        run_id=run_id,
        name=run_id,
        runtime="local",
        state="interrupted",
        started=changed,
        heartbeat=changed,
        total_env_steps=1,
        last_error=cause,
    )


@contextmanager
def _using(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreUnavailableError(
            f"cannot use {path}: {error.strerror}; check the disk and the permissions"
        ) from error


def _read_status(run_id: str, path: Path) -> RunStatus:
    try:
        status = parse_with(RunStatus.model_validate_json, read_regular(path / STATUS_FILE, MAX_BYTES), STATUS_FILE)
    except FileNotFoundError:
        if not (path / RUN_FILE).exists():
            return _damaged(run_id, path, written_by(path, FIRST_VERSION))
        return _damaged(run_id, path, f"{path} has no {STATUS_FILE}: its run has only begun, or it is gone; resume it")
    except (OSError, ParseError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no run's status"
        return _unreadable(run_id, path, f"{STATUS_FILE}: {reason}")
    if status.epoch < newest_epoch(path):
        status = status.suffering("well", f"{STATUS_FILE} is of an earlier process; a newer one has written none yet")
    stopping = status.state in ACTIVE and (status.stopping or (path / STOP_FILE).exists())
    # a copied directory has another id
    return status.model_copy(update={"run_id": run_id, "study": study_of(path), "stopping": stopping})


def _why_silent(status: RunStatus, path: Path, age_s: float) -> RunStatus:
    """The status of a silent run whose process lives, since it has the lock."""
    host, pid = holder(path) or ("", 0)
    who = f"its process {pid} on {host}" if pid else "its process"
    text = f"{who} lives, and has not been heard of for {age_s:.0f} s: it is frozen, hangs, or cannot write here"
    return status.suffering("stuck", f"{text}; once it is ended, --resume goes on from its last checkpoint")


def _why_quiet(status: RunStatus, path: Path) -> RunStatus | None:
    """The status of a run whose process lives and is quiet: a signal froze it, its disk is full, or None."""
    host, pid = holder(path) or ("", 0)
    if host == socket.gethostname() and _is_stopped(pid):
        text = f"its process {pid} on {host} is frozen by a signal; kill -CONT {pid} lets it go on"
        return status.suffering("stuck", text)
    with suppress(OSError):
        if (free := shutil.disk_usage(path).free) < FULL_BYTES:
            text = f"its process lives, and cannot say how it is: the disk of {path} is full ({free:,} bytes are left)"
            return status.suffering("disk", text)
    return None


def _is_stopped(pid: int) -> bool:
    """Whether a process of this machine was stopped by a signal, as far as can be told."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in ("T", "t")
    except (OSError, IndexError):
        return False
