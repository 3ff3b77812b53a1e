"""Live reports as files in the run directory: for ``tandem serve --runs`` and for everyone with a text editor.

| file | content |
|---|---|
| ``status.json`` | ``RunStatus``, at every change of state or condition and else about once a second |
| ``goals.json`` | ``GoalGrid``, about every five seconds |
| ``stop`` | is there when somebody asked the run to stop |

Metrics are in ``metrics.jsonl``, where the run writes them for itself.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path

from pydantic import BaseModel

from service.io.files import write_atomic
from service.io.run_directory import RunDirectory
from service.parsing import ParseError, parse_json, parse_with
from service.regular_files import read_regular
from service.store.models import Condition, GoalGrid, Record, RunState, RunStatus, Trouble

MAX_BYTES = 64 * 1024 * 1024
"""Of a run's status, its grid of goals and its note of what it published."""
STATUS_FILE = "status.json"
GOALS_FILE = "goals.json"
STOP_FILE = "stop"
STATUS_INTERVAL_S = 1.0
GOALS_INTERVAL_S = 5.0
_logger = logging.getLogger(__name__)


def read_status(directory: Path) -> RunStatus | None:
    """The status that the last process of a run left in its directory; None where there is none that can be read."""
    try:
        data = read_regular(directory / STATUS_FILE, MAX_BYTES)
        return parse_with(RunStatus.model_validate_json, data, STATUS_FILE)
    except (OSError, ParseError):
        return None


def read_published(directory: Path) -> str | None:
    """``NAME@VERSION`` of what a run published last; None where there is none, or where that cannot be read."""
    try:
        return str(parse_json(read_regular(directory / "published.json", MAX_BYTES), directory)["version"])
    except (OSError, KeyError, TypeError, ValueError):
        return None


class DiskWriter:
    """Writes reports into one run directory; its caller has the directory's lock.

    A few small files a second are written without waiting for the disk, so the training thread does it by the way.
    """

    def __init__(self, directory: RunDirectory, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Take back the stop request of an earlier process; ``clock`` counts seconds."""
        self._directory = directory
        self._stop_file = directory.path / STOP_FILE
        self._status = _LatestFile(directory.path / STATUS_FILE, STATUS_INTERVAL_S, clock)
        self._goals = _LatestFile(directory.path / GOALS_FILE, GOALS_INTERVAL_S, clock)
        self._told: tuple[RunState, Condition] | None = None
        try:
            self._stop_file.unlink(missing_ok=True)
        except OSError as error:
            _logger.warning("cannot delete %s: %s; the run will stop at once", self._stop_file, error.strerror)

    def status(self, status: RunStatus) -> None:
        """Replace what is known about the run."""
        told = status.state, status.condition
        self._status.put(status, now=told != self._told)
        self._told = told

    def metrics(self, record: Record) -> None:
        """Do nothing: the run directory has its own ``metrics.jsonl``."""

    def goals(self, grid: GoalGrid) -> None:
        """Replace the grid."""
        self._goals.put(grid)

    def stop_requested(self) -> bool:
        """Whether somebody asked the run to stop since it was started."""
        return self._stop_file.exists()

    def check(self) -> None:
        """Assert that this is still the run's driver.

        Raises:
            RunTakenError: another one has taken it over.
        """
        self._directory.check_owner()

    def troubles(self) -> list[Trouble]:
        """Files that cannot be written at the moment, those that the run writes for itself among them."""
        problems = [self._status.problem, self._goals.problem, *self._directory.problems()]
        return [Trouble("disk", problem) for problem in problems if problem is not None]

    def close(self) -> None:
        """Write what still waits."""
        self._status.flush()
        self._goals.flush()


class _LatestFile:
    """Holds the newest of what it is given, not older than ``interval_s`` when something newer comes."""

    def __init__(self, path: Path, interval_s: float, clock: Callable[[], float]) -> None:
        self._path, self._interval_s, self._clock = path, interval_s, clock
        self._waiting: BaseModel | None = None
        self._written_s = float("-inf")
        self.problem: str | None = None

    def put(self, content: BaseModel, *, now: bool = False) -> None:
        self._waiting = content
        if now or self._clock() - self._written_s >= self._interval_s:
            self.flush()

    def flush(self) -> None:
        if self._waiting is None:
            return
        self._written_s = self._clock()
        try:
            write_atomic(self._path, self._waiting.model_dump_json().encode() + b"\n", flush=False)
        except OSError as error:
            problem = f"{self._path.name} cannot be written: {error.strerror}"
            if self.problem is None:
                _logger.warning("%s: %s; the run goes on", self._path.parent, problem)
            self.problem = problem
        else:
            self._waiting, self.problem = None, None
