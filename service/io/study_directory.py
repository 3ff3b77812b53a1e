"""A study directory: runs that differ in nothing but their seed.

| file | content |
|---|---|
| ``study.yaml`` | the configuration of all runs; its ``seed`` counts for none of them |
| ``study.json`` | the seeds, what runs begin from, how far each is, their scores, and the best one |
| ``curves.png`` | the success of all runs over env steps |
| ``seed-N/`` | the run directory of seed N; ``log.txt`` in it has what its processes said |
| ``.lock`` | held by the process that runs the study |
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from service.config import Config, dump_config, load_config
from service.errors import ConfigError, TandemError
from service.io.errors import StorageError
from service.io.files import os_errors, write_atomic
from service.io.lock import LOCK_FILE, DirectoryLock
from service.io.run_directory import RunDirectory
from service.parsing import parse_json
from service.regular_files import read_regular

STUDY_FILE = "study.yaml"
RESULTS_FILE = "study.json"
LOG_FILE = "log.txt"
MAX_RESULTS_BYTES = 16 * 1024 * 1024


def is_study(path: Path) -> bool:
    """Whether a study has begun in this directory."""
    return os.path.isfile(path / STUDY_FILE)


class StudyDirectory:
    """Reads and writes the files of one study; nothing is written before `begin` or `resume`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config_file = path / STUDY_FILE
        self.results_file = path / RESULTS_FILE
        self._lock: DirectoryLock | None = None

    @property
    def exists(self) -> bool:
        """Whether a study has begun here."""
        return is_study(self.path)

    def run(self, seed: int) -> RunDirectory:
        """The directory of one run."""
        return RunDirectory(self.path / f"seed-{seed}")

    def log_file(self, seed: int) -> Path:
        """The file that has all that one run's processes said."""
        return self.run(seed).path / LOG_FILE

    def read_config(self, overrides: Sequence[str] = ()) -> Config:
        """Read the configuration of all runs, with ``overrides`` as in ``load_config``.

        Raises:
            ConfigError: no study here, or its configuration cannot be read.
        """
        self._check_begun()
        return load_config(self.config_file, overrides)

    def read_seeds(self) -> tuple[int, ...]:
        """Read the seeds of the runs.

        Raises:
            ConfigError: no study here.
            StorageError: the file that names them cannot be read.
        """
        self._check_begun()
        with os_errors("read", self.results_file):
            data = read_regular(self.results_file, MAX_RESULTS_BYTES, follow=True)
        try:
            return tuple(int(seed) for seed in parse_json(data, self.results_file)["seeds"])
        except (ValueError, KeyError, TypeError):
            raise StorageError(
                f'{self.results_file} names no seeds; write {{"seeds": [0, 1]}} into it, with those whose directories '
                "are there, and try again"
            ) from None

    def claim(self) -> None:
        """Keep every other process from running this study until ``close``; a second call does nothing.

        Raises:
            RunTakenError: another process runs it.
            StorageError: the directory cannot be written.
        """
        if self._lock is None:
            self._lock = DirectoryLock(self.path, "stop that one first, or name another --run-dir")

    def read_start(self) -> str | None:
        """Read what its runs begin from; None: from nothing.

        Raises:
            StorageError: the file that says so cannot be read.
        """
        with os_errors("read", self.results_file):
            data = read_regular(self.results_file, MAX_RESULTS_BYTES, follow=True)
        found = parse_json(data, self.results_file).get("from")
        return str(found) if found is not None else None

    def begin(self, config: Config, seeds: Sequence[int], start: str | None = None) -> None:
        """Begin a study here, and keep every other process from running it until ``close``.

        Args:
            config: of all runs.
            seeds: of the runs.
            start: reference of what they begin from.

        Raises:
            TandemError: a study, or a run, is here already, or the directory cannot be written.
        """
        self.check_free(seeds)
        self.claim()
        self.check_free(seeds)  # of two that begin at once, the second sees here what the first has made
        self.write_results({"seeds": list(seeds), "from": start})
        self._write_config(config)  # last: a start that failed can be tried again

    def resume(self, config: Config) -> None:
        """Go on with the study here, and keep every other process from running it until ``close``.

        Args:
            config: of all runs from now on.

        Raises:
            TandemError: no study is here, another process runs it, or the directory cannot be written.
        """
        self._check_begun()
        self.claim()
        self._write_config(config)

    def write_results(self, tree: Mapping[str, Any]) -> None:
        """Replace ``study.json``, which has to have ``seeds``.

        Raises:
            StorageError: it cannot be written.
        """
        with os_errors("write", self.results_file):
            write_atomic(self.results_file, json.dumps(tree, indent=1).encode() + b"\n")

    def close(self) -> None:
        """Let other processes in; a second call does nothing."""
        if self._lock is not None:
            if not self.exists:  # a study that did not begin leaves nothing
                with suppress(OSError):
                    (self.path / LOCK_FILE).unlink()
                    self.path.rmdir()
            self._lock.release()
            self._lock = None

    def _write_config(self, config: Config) -> None:
        with os_errors("write", self.config_file):
            write_atomic(self.config_file, dump_config(config).encode())

    def _check_begun(self) -> None:
        if not is_study(self.path):
            raise ConfigError(f"no study in {self.path}: {STUDY_FILE} is missing; begin one with --seeds, no --resume")

    def check_free(self, seeds: Sequence[int]) -> None:
        """Check that neither a study nor one of its runs has begun here.

        Raises:
            TandemError: one has.
        """
        if is_study(self.path):
            raise TandemError(
                f"{self.path} holds a study already; continue it with --resume, or name another --run-dir"
            )
        for directory in (RunDirectory(self.path), *map(self.run, seeds)):
            if directory.exists:
                raise TandemError(f"{directory.path} holds a run already; name another --run-dir for this study")
