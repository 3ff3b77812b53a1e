"""Runs read from their directories."""

from __future__ import annotations

import errno
import math
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from threading import Lock

from typing_extensions import override

from service.base.errors import DamagedStoreError, StoreUnavailableError, UnknownRunError, one_line
from service.base.files import read_regular
from service.base.lock import holder, is_locked, newest_epoch
from service.base.parsing import ParseError, parse_with
from service.store.models import (
    ACTIVE,
    CONFIG_FILE,
    GRID_FILE,
    MAX_BYTES,
    METRICS_FILE,
    SILENT_AFTER,
    STATUS_FILE,
    STOP_FILE,
    STUDY_FILE,
    Columns,
    GoalGrid,
    Pulse,
    Record,
    RunReader,
    RunStatus,
)
from service.store.tail import RecordFile

QUIET_S = 10.0
"""A run writes its status every second; after so long something keeps it from that."""
MAX_COLUMN_BYTES = 512 * 1024 * 1024
"""Of metrics in memory: all 70 of 90 runs with 10,000 iterations each."""
_ALWAYS_NEW_S = 0.5
"""A list that took less than a tenth of this is never kept."""
MAX_KEPT_S = 5.0
_PASSING = (errno.ESTALE, errno.EIO, errno.EAGAIN, errno.EINTR, errno.ETIMEDOUT)
"""Failures of a disk, mostly one of the network, after which it may answer again; the run is what it was."""
FULL_BYTES = 1_000_000
"""A disk with less room than this is full: a status and a grid would not fit."""


def is_study(path: Path) -> bool:
    """Whether a study has begun in this directory."""
    return os.path.isfile(path / STUDY_FILE)


def run_id_of(directory: Path) -> str:
    """A run's id on one machine: the name of its directory; with a dash for what an id may not hold, and a digest then.

    That of a study's run begins with the name of the study.
    """
    path = Path(os.path.realpath(directory))  # ``Path.resolve`` does not survive a loop of links
    name = f"{path.parent.name[: 127 - len(path.name[:100])]}-{path.name}" if is_study(path.parent) else path.name
    known = re.sub(r"[^A-Za-z0-9._-]", "-", name).lstrip("._-")[:128]
    if known == name:
        return known
    return f"{known[:119] or 'run'}-{sha256(name.encode(errors='surrogateescape')).hexdigest()[:8]}"  # no other's id


def study_of(directory: Path) -> str | None:
    """The name of the study whose run this is; None for a run of its own."""
    parent = Path(os.path.realpath(directory)).parent
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


class DiskReader(RunReader):
    """The runs of a directory of run directories; for any number of threads at once.

    Args:
        root: has the run directories.
        clock: counts seconds, and never jumps.
    """

    def __init__(self, root: Path, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.root, self._clock = root, clock
        self._records: dict[Path, RecordFile] = {}
        self._found: dict[str, Path] = {}
        """Directories of the last listing, by the ids of their runs."""
        self._statuses: list[RunStatus] = []
        self._good_until_s = -math.inf
        self._listing = Lock()
        self._in_columns: list[RecordFile] = []
        """Those with columns in memory, the one that was asked for last at the end."""
        self._last: dict[Path, tuple[RunStatus, float]] = {}
        """As they were read last, and when by the clock."""
        self._pulse = Pulse(clock)
        self._lock = Lock()

    @override
    def runs(self) -> list[RunStatus]:
        """A list is kept for ten times as long as it took, so that many clients cost a tenth of a core."""
        with self._listing:
            begun_s = self._clock()
            if begun_s >= self._good_until_s:
                statuses = [self._status(run_id, path) for run_id, path in self._list().items()]
                self._statuses = sorted(statuses, key=lambda status: status.started, reverse=True)
                now_s = self._clock()
                self._good_until_s = now_s + min(10.0 * (now_s - begun_s), MAX_KEPT_S) - _ALWAYS_NEW_S
            return [*self._statuses]

    @override
    def run(self, run_id: str) -> RunStatus:
        return self._status(run_id, self._find(run_id))

    @override
    def metrics(self, run_id: str, *, after_iteration: int = 0, most: int | None = None) -> list[Record]:
        with self._using(run_id) as path:
            return self._records_of(path).after(after_iteration, most)

    @override
    def newest(self, run_id: str) -> Record | None:
        with self._using(run_id) as path:
            return self._records_of(path).newest()

    @override
    def columns(self, run_id: str, names: Sequence[str] | None) -> Columns:
        """What was read stays in memory, up to ``MAX_COLUMN_BYTES`` of all runs."""
        with self._using(run_id) as path:
            records = self._records_of(path)
            found = records.columns(names)
        with self._lock:
            self._in_columns = [each for each in self._in_columns if each is not records] + [records]
            while len(self._in_columns) > 1 and sum(each.num_bytes for each in self._in_columns) > MAX_COLUMN_BYTES:
                self._in_columns.pop(0).forget()
        return found

    @override
    def sample(self, run_id: str, name: str, number: int) -> list[float | None]:
        with self._using(run_id) as path:
            return self._records_of(path).sample(name, number)

    @override
    def goals(self, run_id: str) -> GoalGrid | None:
        with self._using(run_id) as path:
            try:
                return parse_with(GoalGrid.model_validate_json, read_regular(path / GRID_FILE, MAX_BYTES), path)
            except FileNotFoundError:
                return None
            except ParseError:
                raise DamagedStoreError(
                    f"{path / GRID_FILE} is no goal grid; delete it, a run writes it anew"
                ) from None

    @override
    def request_stop(self, run_id: str) -> None:
        with self._using(run_id) as path:
            try:
                is_active = self._read_status(run_id, path).state in ACTIVE
            except ParseError as error:
                raise DamagedStoreError(
                    f"{path}: the run was not asked to stop, its status is damaged: {error}"
                ) from None
            if is_active:
                (path / STOP_FILE).touch()

    @override
    def ready(self) -> None:
        with self._reading_root():
            os.scandir(self.root).close()

    def _status(self, run_id: str, path: Path) -> RunStatus:
        try:
            status = self._read_status(run_id, path)
        except Exception as error:  # whatever a directory holds, it must not hide the other runs
            last, read_s = self._last.get(path, (None, 0.0))
            is_young = self._clock() - read_s < SILENT_AFTER.total_seconds()
            if isinstance(error, OSError) and error.errno in _PASSING and last is not None and is_young:
                return last.suffering("well", f"{STATUS_FILE} cannot be read right now: {error.strerror}")
            self.ready()  # or nothing is wrong with this run alone
            return _damaged(run_id, path, f"{path} cannot be read: {one_line(str(error), 300)}")
        if (number := self._records_of(path).num_passed_over) > 0:
            status = status.suffering("well", f"metrics.jsonl: lines that are no records and are passed over: {number}")
        self._last[path] = status, self._clock()
        return status

    def _read_status(self, run_id: str, path: Path) -> RunStatus:
        try:
            status = parse_with(RunStatus.model_validate_json, read_regular(path / STATUS_FILE, MAX_BYTES), STATUS_FILE)
        except FileNotFoundError:
            begun = f"{path} has no {STATUS_FILE}: its run has only begun, or it is gone; resume it"
            return _damaged(run_id, path, begun)
        if status.epoch < newest_epoch(path):
            text = f"{STATUS_FILE} is of an earlier process; a newer one has written none yet"
            status = status.suffering("well", text)
        stopping = status.state in ACTIVE and (status.stopping or (path / STOP_FILE).exists())
        # a copied directory has another id
        status = status.model_copy(update={"run_id": run_id, "study": study_of(path), "stopping": stopping})
        status, age_s = self._pulse.look(status)
        if status.state not in ACTIVE or age_s <= QUIET_S:
            return status
        silent = age_s > SILENT_AFTER.total_seconds()
        if not is_locked(path):
            return status.vanished() if silent else status
        if (free := shutil.disk_usage(path).free) < FULL_BYTES:
            text = f"its process lives, and cannot say how it is: the disk of {path} is full ({free:,} bytes are left)"
            return status.suffering("disk", text)
        if not silent:
            return status
        host, pid = holder(path) or ("", 0)
        who = f"its process {pid} on {host}" if pid else "its process"
        text = f"{who} lives, and has not been heard of for {age_s:.0f} s: it is frozen, hangs, or cannot write here"
        return status.suffering("stuck", f"{text}; once it is ended, --resume goes on from its last checkpoint")

    @contextmanager
    def _using(self, run_id: str) -> Iterator[Path]:
        """Give the directory of a run, of which a file is used in the block."""
        path = self._find(run_id)
        try:
            yield path
        except OSError as error:
            raise StoreUnavailableError(
                f"cannot use the files in {path}: {error.strerror}; check the disk and the permissions"
            ) from error

    @override
    def directories(self) -> dict[str, Path]:
        try:
            return self._list()
        except StoreUnavailableError:
            return {}

    @override
    def directory(self, run_id: str) -> Path | None:
        try:
            return self._find(run_id)
        except (StoreUnavailableError, UnknownRunError):
            return None

    def _find(self, run_id: str) -> Path:
        known = self._found.get(run_id)
        if known is not None and _is_run(known):  # many clients ask for a few runs, again and again
            return known
        runs = self._list()
        if run_id not in runs:
            raise UnknownRunError.of(run_id, self.root, sorted(runs))
        return runs[run_id]

    def _list(self) -> dict[str, Path]:
        """Directory of each run, by its id."""
        with self._reading_root():
            self._found = run_directories(self.root)
        return self._found

    @contextmanager
    def _reading_root(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise StoreUnavailableError(
                f"cannot read the runs in {self.root}: {error.strerror}; name the directory that holds run directories"
            ) from error

    def _records_of(self, path: Path) -> RecordFile:
        return self._records.setdefault(path, RecordFile(path / METRICS_FILE))


def _is_run(path: Path) -> bool:
    """Whether it is a run's directory, or one that cannot be looked into, which may be a run's."""
    if path.name.startswith(".") or path.name == "lost+found":  # the latter is of the file system
        return False
    try:
        os.stat(f"{path}/.")
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:  # such as a loop of links, or no permission; the status says which
        return True
    return any(os.path.isfile(path / name) for name in (STATUS_FILE, CONFIG_FILE))


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
