"""Checkpoints of a run, from which it continues bit-identically.

A checkpoint is one safetensors file. Its header holds a JSON text with the format version, the step, the caller's meta,
and a sha256 over that text and all arrays, so that any changed bit is found.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.base import tensors
from service.base.errors import CheckpointError, FormatVersionError
from service.base.files import os_errors, read_regular, remove_temporaries, write_atomic
from service.base.parsing import parse_json

FORMAT_VERSION = 1
_HEADER_KEY = "tandem_checkpoint"
_FILE_PATTERN = re.compile(r"checkpoint-(?:e([0-9]{8,})-)?([0-9]{8,})\.safetensors")
_logger = logging.getLogger(__name__)


class Checkpoint(NamedTuple):
    """A saved state: the step, the arrays by name, and the plain values."""

    step: int
    arrays: dict[str, np.ndarray]
    meta: dict[str, Any]


class CheckpointStore:
    """The checkpoints of one run in a directory; one writer, any number of readers.

    The newest is that of the highest epoch (``epoch``), and of its checkpoints that of the last step: what a process
    writes that was overtaken by another one is never read.

    Args:
        directory: made when missing.
        keep: how many stay when one is saved; None: all.
        epoch: of the process that writes; 0 where there is never more than one.
    """

    def __init__(self, directory: Path, keep: int | None = None, *, epoch: int = 0) -> None:
        assert keep is None or keep >= 1
        self.directory, self.keep, self.epoch = directory, keep, epoch
        self._damaged: set[Path] = set()

    def path(self, step: int) -> Path:
        """File to which this process writes the checkpoint of ``step``, there or not."""
        epoch = f"e{self.epoch:08d}-" if self.epoch else ""
        return self.directory / f"checkpoint-{epoch}{step:08d}.safetensors"

    def steps(self) -> list[int]:
        """The steps of which a checkpoint is there, good or damaged, the newest last."""
        return [step for _, step, _ in self._files()]

    def newest(self) -> Path | None:
        """File of the newest checkpoint, good or damaged; None where there is none."""
        files = self._files()
        return files[-1][2] if files else None

    def _files(self) -> list[tuple[int, int, Path]]:
        """Epoch, step and file of every checkpoint, the newest last; none where the directory cannot be read."""
        try:
            entries = list(self.directory.iterdir())
        except OSError:
            return []
        matches = ((_FILE_PATTERN.fullmatch(entry.name), entry) for entry in entries)
        return sorted((int(match[1] or 0), int(match[2]), entry) for match, entry in matches if match)

    def check_any(self) -> None:
        """Check that there is a checkpoint, good or damaged.

        Raises:
            CheckpointError: there is none.
        """
        if not self.steps():
            raise CheckpointError(f"no checkpoint in {self.directory}; name another run, or start without --resume")

    def save(self, step: int, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> Path:
        """Write a checkpoint to the disk, then delete those older than the newest ``keep``, if that is given.

        Args:
            step: the iteration after which the state was taken, >= 0.
            arrays: any shape and memory order; see `tensors.encode`.
            meta: plain JSON values; integers of up to 300 digits, NaN and infinities come back exactly, tuples as
                lists.

        Raises:
            CheckpointError: a full disk; earlier checkpoints are intact.
            TypeError, ValueError: a value or an array that cannot be saved; nothing was written.
        """
        assert step >= 0
        path = self.path(step)
        content = {"format_version": FORMAT_VERSION, "step": step, "meta": dict(meta)}
        digest = tensors.digest_of(json.dumps(content, sort_keys=True), arrays)
        data = tensors.encode(arrays, {_HEADER_KEY: json.dumps({**content, "sha256": digest}, sort_keys=True)})
        write_atomic(path, data, CheckpointError)
        self._prune(step)
        return path

    def load_latest(self) -> Checkpoint:
        """The newest checkpoint that is whole; a damaged one is passed over with a warning in the log.

        Raises:
            CheckpointError: there is none.
            FormatVersionError: the newest readable one is of another format.
        """
        self.check_any()
        reasons: list[str] = []
        for _, _, path in reversed(self._files()):
            try:
                checkpoint = read_checkpoint(path)
            except CheckpointError as error:
                reasons.append(str(error))
                self._damaged.add(path)
                continue
            for reason in reasons:
                _logger.warning("%s; continuing from %s", reason, path.name)
            return checkpoint
        raise CheckpointError(f"no usable checkpoint in {self.directory}: {'; '.join(reasons)}; start the run anew")

    def _prune(self, newest: int) -> None:
        # What another process writes in a higher epoch is not for this one to delete, and a damaged file that was
        # passed over, of whatever epoch and step, must not crowd out a good one.
        files = [path for epoch, step, path in self._files() if (epoch, step) <= (self.epoch, newest)]
        kept = [path for path in files if path not in self._damaged][-(self.keep or 0) :]
        try:
            for path in files[: files.index(kept[0])] if kept else ():  # none where the directory cannot be read
                path.unlink(missing_ok=True)
            remove_temporaries(self.directory)
        except OSError as error:
            _logger.warning("cannot delete old checkpoints in %s: %s", self.directory, error.strerror)


def read_checkpoint(path: Path) -> Checkpoint:
    """Read and verify one checkpoint file.

    Raises:
        CheckpointError: it cannot be read, or is damaged.
        FormatVersionError: it is of another format.
    """
    with os_errors("read", path, CheckpointError):
        data = read_regular(path, follow=True)
    try:
        header = parse_json(tensors.read_metadata(data, _HEADER_KEY), path, allow_nan=True)
        format_version = header["format_version"]
    except (ValueError, KeyError, TypeError):
        raise CheckpointError(f"{path} is damaged: its header cannot be read") from None
    if format_version != FORMAT_VERSION:
        raise FormatVersionError.of(path, found=format_version, supported=FORMAT_VERSION)
    expected = header.pop("sha256", None)
    try:
        arrays = tensors.decode(data)
    except ValueError as error:
        raise CheckpointError(f"{path} is damaged: {error}") from None
    actual = tensors.digest_of(json.dumps(header, sort_keys=True), arrays)
    if actual != expected:
        raise CheckpointError(f"{path} is damaged: expected sha256 {expected}, it has {actual}")
    return Checkpoint(header["step"], arrays, header["meta"])
