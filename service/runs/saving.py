"""Checkpoints and snapshots of a run: what it resumes from, and what it could do at each tenth of its way."""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from service.base.jsonl import Extent
from service.base.tensors import split_parts
from service.base.types import Arrays
from service.config import Config
from service.methods.method import State
from service.policies.parameters import Parameters
from service.runs.resuming import changed_settings
from service.store.checkpoints import CheckpointStore
from service.store.run_directory import Resumption, RunDirectory

NUM_SNAPSHOTS = 10
"""Snapshots of what was learned, evenly over a run's env steps; one of it untrained comes before them."""
_logger = logging.getLogger(__name__)


class Saves:
    """Writes and reads the checkpoints and snapshots of one run, whose directory has been claimed."""

    def __init__(self, config: Config, directory: RunDirectory) -> None:
        self._config, self._directory = config, directory
        self.checkpoints = CheckpointStore(directory.checkpoints, config.run.keep_checkpoints, epoch=directory.epoch)
        self._snapshots = CheckpointStore(directory.snapshots, keep=sys.maxsize)
        self.saved: int | None = None
        """The iteration of the newest checkpoint, where the records are as it says; None before the first."""

    def load(self) -> tuple[Resumption, State, float]:
        """Read the newest checkpoint, once it is clear that it is of this run, and that its records are there.

        Returns:
            Where the run goes on, the method's state, and the seconds that it took so far.

        Raises:
            CheckpointError: there is no usable one, or it is of another run or configuration.
            StorageError: see ``RunDirectory.check_resumable``.
        """
        checkpoint = self.checkpoints.load_latest()
        meta = checkpoint.meta
        changed = changed_settings(meta["config"], self._config, self._directory.path)
        records = {name: Extent(*extent) for name, extent in meta["records"].items()}
        resumption = Resumption(checkpoint.step, int(meta["env_steps"]), meta["run"], records, changed)
        if self._directory.check_resumable(resumption):
            self.saved = checkpoint.step
        if changed:
            said = ", ".join(f"{key} from {was!r} to {now!r}" for key, (was, now) in changed.items())
            _logger.info("changed since iteration %d: %s", checkpoint.step, said)
        return resumption, {**split_parts(checkpoint.arrays), **meta["state"]}, float(meta["wall_s"])

    def save(self, iteration: int, state: State, counters: Mapping[str, Any]) -> None:
        """Write a checkpoint of an iteration: with it alone a new process goes on.

        Args:
            iteration: that has ended.
            state: of the method.
            counters: of the run, plain values.

        Raises:
            CheckpointError: a full disk; earlier checkpoints are intact.
        """
        directory = self._directory
        directory.check_owner()
        arrays, values = flatten(state)
        meta = {
            **counters,
            "config": self._config.model_dump(mode="json"),
            "run": directory.history.run,
            "records": directory.sync(),
            "state": values,
        }
        with directory.noting(directory.checkpoints):
            self.checkpoints.save(iteration, arrays, meta)
        self.saved = iteration

    def snapshot_due(self, before: int, now: int) -> bool:
        """Whether a tenth of the budget lies between these env steps."""
        tenths = [steps * NUM_SNAPSHOTS // self._config.run.total_env_steps for steps in (before, now)]
        return tenths[0] != tenths[1]

    def take_snapshot(self, iteration: int, num_env_steps: int, parameters: Parameters) -> None:
        """Keep what was learned for good: checkpoints go, and later it is asked what could be done when.

        A resumed run takes those it takes again with the same bits.

        Raises:
            CheckpointError: a full disk.
        """
        arrays = {f"{self._config.part}/{name}": array for name, array in parameters.items()}
        self._snapshots.save(iteration, arrays, {"env_steps": num_env_steps})


def flatten(state: State) -> tuple[Arrays, dict[str, Any]]:
    """The arrays of a state as ``COMPONENT/NAME``, and its plain values by name."""
    arrays: Arrays = {}
    values: dict[str, Any] = {}
    for name, part in state.items():
        if isinstance(part, Mapping) and all(isinstance(each, np.ndarray) for each in part.values()):
            arrays |= {f"{name}/{key}": array for key, array in part.items()}
        else:
            values[name] = part
    return arrays, values
