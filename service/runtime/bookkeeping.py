"""Bookkeeping of a run: counters, checkpoints, snapshots of Bob, and what is due when."""

from __future__ import annotations

import logging
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from numpy.typing import NDArray

from service.config import Config
from service.errors import DivergedError
from service.io.checkpoints import Checkpoint, CheckpointStore
from service.io.errors import CheckpointError
from service.io.run_directory import RunDirectory
from service.io.run_history import FILE as RUN_FILE
from service.policies.parameters import Parameters, PolicyError
from service.runtime.resuming import changed_settings
from service.types import Arrays

_logger = logging.getLogger(__name__)

NUM_SNAPSHOTS = 10
"""Snapshots of Bob, evenly over a run's env steps; one of him untrained comes before them."""


class UnsavedError(CheckpointError):
    """A run has ended, and its last checkpoint could not be written."""

    exit_code = 1


class Bookkeeper:
    """Counters, checkpoints and snapshots of one run.

    Args:
        config: the run.
        directory: where it keeps everything.
    """

    iteration: int
    """Finished iterations."""
    num_env_steps: int
    wall_s: float
    """Seconds spent on iterations, by all processes that ran this run."""

    def __init__(self, config: Config, directory: RunDirectory) -> None:
        self.config = config
        self.directory = directory
        epoch = directory.epoch.number if directory.epoch is not None else 0
        self.checkpoints = CheckpointStore(directory.checkpoints, config.run.keep_checkpoints, epoch=epoch)
        self._snapshots = CheckpointStore(directory.snapshots, keep=sys.maxsize)
        self.iteration, self.num_env_steps, self.wall_s = 0, 0, 0.0
        self._saved: int | None = None

    def resume(self) -> tuple[dict[str, Arrays], dict[str, Any]]:
        """Take over the newest checkpoint's counters, once it is clear that it is of this run, and its records are.

        Returns:
            Its arrays by part, and what else was saved.

        Raises:
            CheckpointError: there is no usable one, or it is of another run or configuration.
            StorageError: see ``RunDirectory.check_records``.
        """
        checkpoint = self.checkpoints.load_latest()
        self._check_same_run(checkpoint)
        parts: dict[str, Arrays] = defaultdict(dict)
        for name, array in checkpoint.arrays.items():
            part, _, rest = name.partition("/")
            parts[part][rest] = array
        if (records := checkpoint.meta.get("records")) is not None:
            self._saved = checkpoint.step if self.directory.check_records(records) else None
        else:
            _logger.warning("%s: an earlier version saved it, and nobody knows its records", self.directory.path)
        self.iteration, self.num_env_steps = checkpoint.step, int(checkpoint.meta["env_steps"])
        self.wall_s = float(checkpoint.meta["wall_s"])
        _logger.info("resumed at iteration %d, %d env steps", self.iteration, self.num_env_steps)
        return parts, checkpoint.meta

    def _check_same_run(self, checkpoint: Checkpoint) -> None:
        history, theirs = self.directory.history, checkpoint.meta.get("run")
        if history is not None and theirs is not None and theirs != history.run:
            raise CheckpointError(
                f"{self.directory.path}: its newest checkpoint is of another run ({theirs[:8]}, not "
                f"{history.run[:8]}); put that of this run back, or remove {RUN_FILE} if the "
                "records are the other run's, too"
            )
        changed = changed_settings(checkpoint.meta.get("config", {}), self.config, self.directory.path)
        if changed:
            said = ", ".join(f"{key} from {was!r} to {now!r}" for key, (was, now) in changed.items())
            _logger.info("changed since iteration %d: %s", checkpoint.step, said)
        self.directory.take_over(theirs, changed)

    @property
    def budget_spent(self) -> bool:
        """Whether the run has had all its env steps."""
        return self.num_env_steps >= self.config.run.total_env_steps

    @property
    def save_due(self) -> bool:
        """Whether a checkpoint is to be written after this iteration."""
        return self.iteration % self.config.run.checkpoint_interval == 0

    def evaluation_due(self, iteration: int) -> bool:
        """Whether Bob is to be evaluated once so many iterations are finished."""
        interval = self.config.run.evaluation_interval
        return interval > 0 and iteration % interval == 0

    def count(self, num_env_steps: int) -> None:
        """Count an iteration and its env steps."""
        self.iteration += 1
        self.num_env_steps += num_env_steps

    def save(self, parts: Mapping[str, Mapping[str, NDArray[Any]]], meta: Mapping[str, Any]) -> None:
        """Write a checkpoint of this iteration: with it alone a new process goes on.

        Args:
            parts: arrays by part and name.
            meta: plain values beside the counters.

        Raises:
            CheckpointError: a full disk; earlier checkpoints are intact.
        """
        self.directory.check_owner()
        arrays = {f"{part}/{name}": array for part, state in parts.items() for name, array in state.items()}
        config = self.config.model_dump(mode="json")
        own = {"config": config, "env_steps": self.num_env_steps, "wall_s": self.wall_s}
        assert self.directory.history is not None
        own |= {"run": self.directory.history.run, "records": self.directory.checksums()}
        self.directory.sync()
        with self.directory.noting(self.directory.checkpoints):
            self.checkpoints.save(self.iteration, arrays, {**own, **meta})
        self._saved = self.iteration

    @property
    def saved(self) -> bool:
        """Whether this iteration has a checkpoint."""
        return self._saved == self.iteration

    @contextmanager
    def tolerating(self, consequence: str) -> Iterator[None]:
        """Warn of a full disk and go on: what was saved before is intact, and what comes may fit."""
        try:
            yield
        except CheckpointError as error:
            _logger.warning("%s; the run goes on, %s", error, consequence)

    @contextmanager
    def explaining_divergence(self) -> Iterator[None]:
        """Add to the error of a policy that has diverged when that was, and how to go on from before it.

        Raises:
            DivergedError: a policy has.
        """
        played = self.iteration
        try:
            yield
        except (DivergedError, PolicyError) as error:
            newest, learner = self.checkpoints.newest(), self.config.learner
            is_played = newest is not None and self.checkpoints.steps()[-1] == played
            has_it = f"delete {newest.name}, which has this policy; " if newest is not None and is_played else ""
            rates = f"alice.learning_rate={learner.alice.learning_rate / 2:g} --set learner.bob.learning_rate="
            said = str(error).strip().splitlines()[-1]  # from another process it comes with its traceback
            raise DivergedError(
                f"{self.directory.path}, iteration {played + 1}: {said}: {has_it}resume with lower learning rates, "
                f"for example --resume --set learner.{rates}{learner.bob.learning_rate / 2:g}"
            ) from error

    @contextmanager
    def explaining_unsaved(self) -> Iterator[None]:
        """Say what is lost where the last checkpoint of a run cannot be written.

        Raises:
            UnsavedError: it could not be written.
        """
        try:
            yield
        except CheckpointError as error:
            saved = next(reversed(self.checkpoints.steps()), None)
            raise UnsavedError(
                f"{error}; the run is at iteration {self.iteration}, saved is iteration {saved}: --resume goes on there"
            ) from error

    def snapshot_due(self, *, after: int) -> bool:
        """Whether a tenth of the budget was reached after that many env steps."""
        tenths = [steps * NUM_SNAPSHOTS // self.config.run.total_env_steps for steps in (after, self.num_env_steps)]
        return tenths[0] != tenths[1]

    def take_snapshot(self, parameters: Parameters) -> None:
        """Keep what was learned for good.

        Checkpoints go, but what could be done at the beginning and in the middle is asked when the run is over. A
        resumed run takes those it takes again with the same bits.

        Raises:
            CheckpointError: a full disk.
        """
        part = "bob" if self.config.skills is None else "skills"
        arrays = {f"{part}/{name}": array for name, array in parameters.items()}
        self._snapshots.save(self.iteration, arrays, {"env_steps": self.num_env_steps})
