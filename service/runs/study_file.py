"""The directory of a study: runs side by side.

| file | content |
|---|---|
| ``study.json`` | the settings of each run, how far it is, and its results; the best one |
| ``NAME.yaml`` | the configuration that the run NAME begins with |
| ``NAME/`` | its run directory; ``log.txt`` in it has what its processes said |
| ``results.csv``, ``curves.png`` | at the end: a line and a curve for each run |
| ``.lock`` | held by the process that runs the study |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field, JsonValue, ValidationError

from service.base.errors import ConfigError, StorageError, TandemError
from service.base.files import os_errors, read_regular, write_atomic
from service.base.lock import LOCK_FILE, DirectoryLock
from service.base.parsing import ParseError, parse_json
from service.config import Config, dump_config, load_config
from service.config.frozen import FrozenModel
from service.runs.grid import Settings
from service.store.models import STUDY_FILE, RunState
from service.store.run_directory import RunDirectory
from service.store.run_history import SECOND_VERSION, written_by

MAX_BYTES = 64 * 1024 * 1024
ENDED = ("finished", "converged")
"""States in which a run has learned all it was to learn."""


class StudyRun(FrozenModel):
    """How far a run of a study is."""

    settings: Settings = Field(description="by which it differs from others")
    state: RunState | Literal["waiting"] = "waiting"
    env_steps: int = 0
    wall_s: float = 0.0
    error: str | None = Field(None, description="reason of a failure, in one line")
    result: dict[str, float] = Field({}, description="what was measured at its end")

    @property
    def has_ended(self) -> bool:
        """Whether it has learned all it was to learn."""
        return self.state in ENDED


class StudyFile(FrozenModel):
    """Content of ``study.json``."""

    start: str | None = Field(None, description="reference of what the runs begin from")
    runs: dict[str, StudyRun]
    best: str | None = Field(None, description="name of the best run")
    published: str | None = Field(None, description="version of its primitives")


@dataclass(frozen=True, slots=True)
class SavedConfig:
    """The file with the configuration of one run of a study."""

    file: Path

    def read_config(self, overrides: Sequence[str] = ()) -> Config:
        """Read it with ``overrides`` as in ``load_config``.

        Raises:
            ConfigError: it cannot be read.
        """
        return load_config(self.file, overrides)


class StudyDirectory:
    """Reads and writes the files of a study; nothing is written before ``begin`` or ``write``."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = path / STUDY_FILE
        self._lock: DirectoryLock | None = None

    @property
    def exists(self) -> bool:
        """Whether a study has begun here."""
        return self.file.is_file()

    def config(self, name: str) -> SavedConfig:
        """The configuration of a run."""
        return SavedConfig(self._config_file(name))

    def read(self) -> StudyFile:
        """Read ``study.json``.

        Raises:
            TandemError: no study here, one of another version, or its file cannot be read.
        """
        if not self.exists:
            raise ConfigError(f"no study in {self.path}: {STUDY_FILE} is missing; leave out --resume to begin one")
        with os_errors("read", self.file):
            data = read_regular(self.file, MAX_BYTES, follow=True)
        with suppress(ParseError, ValidationError):
            tree: JsonValue = parse_json(data, self.file)
            if isinstance(tree, dict) and "seeds" in tree:
                raise ConfigError(written_by(self.file, SECOND_VERSION))
            return StudyFile.model_validate(tree)
        raise StorageError(
            f"{self.file} does not name the runs of a study; restore it from a copy, or go on with each run by "
            "--resume --run-dir"
        )

    def claim(self) -> None:
        """Keep every other process from running this study until ``close``; a second call does nothing.

        Raises:
            RunTakenError: another process runs it.
            StorageError: the directory cannot be written.
        """
        if self._lock is None:
            self._lock = DirectoryLock(self.path, "stop that one first, or name another --run-dir")

    def check_free(self, names: Sequence[str] = ()) -> None:
        """Check that neither a study nor one of its runs has begun here.

        Raises:
            TandemError: one has.
        """
        if self.exists:
            raise TandemError(
                f"{self.path} holds a study already; continue it with --resume, or name another --run-dir"
            )
        for directory in (RunDirectory(self.path), *(RunDirectory(self.path / name) for name in names)):
            if directory.exists:
                raise TandemError(f"{directory.path} holds a run already; name another --run-dir for this study")

    def begin(self, runs: Mapping[str, tuple[Settings, Config]], start: str | None) -> None:
        """Begin a study here.

        Args:
            runs: settings and configuration of each.
            start: reference of what they begin from.

        Raises:
            TandemError: a study, or a run, is here already, or the directory cannot be written.
        """
        self.claim()
        self.check_free(list(runs))  # of two that begin at once, the second sees here what the first has made
        for name, (_, config) in runs.items():
            self.write_config(name, config)
        # Last: a start that failed can be tried again.
        self.write(StudyFile(start=start, runs={name: StudyRun(settings=each) for name, (each, _) in runs.items()}))

    def write(self, study: StudyFile) -> None:
        """Replace ``study.json``.

        Raises:
            StorageError: it cannot be written.
        """
        self.write_file(STUDY_FILE, study.model_dump_json(indent=1) + "\n")

    def write_config(self, name: str, config: Config) -> None:
        """Replace the configuration of a run.

        Raises:
            StorageError: it cannot be written.
        """
        self.write_file(self._config_file(name).name, dump_config(config))

    def write_file(self, name: str, text: str) -> None:
        """Replace a file.

        Raises:
            StorageError: it cannot be written.
        """
        with os_errors("write", self.path / name):
            write_atomic(self.path / name, text.encode())

    def close(self) -> None:
        """Let other processes in; a second call does nothing."""
        if self._lock is not None:
            if not self.exists:  # a study that did not begin leaves nothing
                with suppress(OSError):
                    (self.path / LOCK_FILE).unlink()
                    self.path.rmdir()
            self._lock.release()
            self._lock = None

    def _config_file(self, name: str) -> Path:
        return self.path / f"{name}.yaml"
