"""A run that goes on, for those who watch: its newest players, and how well Bob does.

A thread looks into the run's directory every two seconds. The loop that shows the world never waits for it.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.registry.loading import Trained, load
from service.store.checkpoints import CheckpointStore
from service.store.disk_reader import DiskReader, run_id_of
from service.store.models import ACTIVE, GoalGrid, read_status
from service.store.run_directory import RunDirectory

LOOK_S = 2.0
"""Between two looks into the directory."""
SUCCESS = ("evaluation/mixed_success_last", "evaluation/success_last")
"""Of self-play, and of a task."""
_PIXELS_A_CELL = 16
_UNKNOWN, _HOPELESS, _SOLVED = np.array([225, 225, 225]), np.array([205, 60, 50]), np.array([60, 160, 80])
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Learning:
    """How far a run is."""

    players: Trained | None
    """The newest."""
    num_env_steps: int
    total_env_steps: int
    success: float | None
    """Bob's on random goals, when that was last measured."""
    goal_map: NDArray[np.uint8] | None
    """(H, W, 3) the workspace from above: where Bob solves goals. None before Alice has proposed one."""


class Following:
    """What a run makes while it goes on.

    Args:
        path: directory of the run.
        registry: where it takes things from.
        primitives: what a policy of a task acts with, where that has moved.
    """

    def __init__(self, path: Path, registry: Path | str, primitives: str | None = None) -> None:
        self._path, self._from, self._stop = path.absolute(), (registry, primitives), threading.Event()
        self._reader, self._run_id = DiskReader(self._path.parent), run_id_of(self._path)
        self._seen: Path | None = None
        self._players: Trained | None = None
        self.learning: Learning | None = None
        """As it was seen last."""
        self._thread = threading.Thread(target=self._follow, name="following", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Look no more."""
        self._stop.set()
        self._thread.join()

    def look(self) -> None:
        """Look into the directory once.

        Raises:
            TandemError: something is damaged, or goes away while it is read.
        """
        newest = CheckpointStore(RunDirectory(self._path).checkpoints).newest()
        if newest != self._seen:
            self._players, self._seen = load(str(self._path), *self._from), newest
        recorded = self._reader.columns(self._run_id, SUCCESS)
        rates = next(iter(recorded.metrics.values()), np.empty(0))
        measured = rates[~np.isnan(rates)]
        self.learning = Learning(
            self._players,
            int(recorded.env_steps[-1]) if len(recorded.env_steps) else 0,
            self._reader.run(self._run_id).total_env_steps,
            float(measured[-1]) if len(measured) else None,
            goal_map(self._reader.goals(self._run_id)),
        )

    def _follow(self) -> None:
        while not self._stop.is_set():
            try:
                self.look()
            except Exception as error:  # what it reads may be replaced meanwhile; the next look finds it
                _logger.debug("following %s: %s", self._path, error)
            self._stop.wait(LOOK_S)


def is_running(path: Path) -> bool:
    """Whether a directory is that of a run that goes on."""
    if not path.is_dir() or read_status(path) is None:
        return False
    return DiskReader(path.absolute().parent).run(run_id_of(path)).state in ACTIVE  # which knows of those that vanished


def goal_map(grid: GoalGrid | None) -> NDArray[np.uint8] | None:
    """(H, W, 3) success over the workspace from above, mean over heights; the robot is below, its left is left."""
    if grid is None or not grid.cells:
        return None
    place = np.array([cell.center_m[:2] for cell in grid.cells])
    index = np.floor((place - grid.lower_m[:2]) / grid.cell_size_m + 1e-6).astype(int)
    total, count = np.zeros(grid.shape[:2]), np.zeros(grid.shape[:2])
    np.add.at(total, tuple(index.T), [cell.success_rate for cell in grid.cells])
    np.add.at(count, tuple(index.T), 1)
    rate = (total / np.maximum(count, 1))[..., None]
    colors = np.where(count[..., None] > 0, _HOPELESS + rate * (_SOLVED - _HOPELESS), _UNKNOWN)
    large: NDArray[np.uint8] = colors[::-1, ::-1].repeat(_PIXELS_A_CELL, 0).repeat(_PIXELS_A_CELL, 1).astype(np.uint8)
    return large
