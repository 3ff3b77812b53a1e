"""The table's directory: one JSON file per trial, written when the trial has ended, never overwritten."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from service.downstream.directory import FORMAT_VERSION, read_json, read_trial, to_json
from service.downstream.methods import METHODS
from service.downstream.settings import TrialConfig, differences
from service.downstream.worker import Provenance
from service.errors import TandemError
from service.io.files import os_errors, write_exclusive

Result = dict[str, Any]


class ResultsDirectory:
    """The results of trials, by their names."""

    def __init__(self, path: Path) -> None:
        """Name the directory, which need not exist; nothing is read before it is asked for."""
        self.path = path

    def find(self, trial: TrialConfig, provenance: Provenance) -> Result | None:
        """Find the result of a trial; None where it has not been run.

        Raises:
            TandemError: the file is damaged, of another format version, or of other settings or primitives.
        """
        path = self._file(trial)
        if not path.exists():
            return None
        result = _read(path)
        wanted = _settings(trial) | provenance.of(trial.method)
        if wrong := differences(_settings(read_trial(result, path)) | _made_with(result), wanted):
            raise TandemError(f"{path} is of {'; '.join(wrong)}: give the same settings, or name another directory")
        return result

    def missing(self, trials: Iterable[TrialConfig], provenance: Provenance) -> list[TrialConfig]:
        """List the trials that have to be run; every file is checked before any is.

        What is in the directory and what is asked for comes onto one page: of the same world, of the same primitives
        where a method takes any, and the seeds of a method on a task with the same settings.

        Raises:
            TandemError: as for ``find``; or the page would mix what cannot be compared.
        """
        missing = [trial for trial in trials if self.find(trial, provenance) is None]
        of_all_seeds = {(each.method, each.task): (f"{each.name}, asked for,", _settings(each)) for each in missing}
        for path in self._files():
            result = _read(path)
            trial = read_trial(result, path)
            if wrong := differences(_made_with(result), provenance.of(trial.method)):
                raise TandemError(f"{path} is of {'; '.join(wrong)}: name another directory, or move it away")
            other, settings = of_all_seeds.setdefault((trial.method, trial.task), (str(path), _settings(trial)))
            if wrong := differences(_settings(trial) | {"seed": 0}, settings | {"seed": 0}):
                raise TandemError(f"{path} and {other} are seeds of one method, but of {'; '.join(wrong)}")
        return missing

    def add(self, trial: TrialConfig, result: Result) -> None:
        """Keep a result, in one step.

        Raises:
            TandemError: there is one already, or the disk is full.
        """
        path = self._file(trial)
        with os_errors("write", path):
            path.parent.mkdir(parents=True, exist_ok=True)
            kept = write_exclusive(path, to_json(result))
        if not kept:
            raise TandemError(f"{path} is there already; another process runs the same table")

    def read_all(self) -> list[Result]:
        """Read every result there, by task, method and seed.

        Raises:
            TandemError: a file is damaged or of another format version.
        """
        return [_read(path) for path in self._files()]

    def _file(self, trial: TrialConfig) -> Path:
        return self.path / f"{trial.name}.json"

    def _files(self) -> list[Path]:
        return sorted(self.path.glob("*.json"))


def _made_with(result: Result) -> dict[str, Any]:
    return {key: result.get(key) for key in ("primitives", "world")}


def _settings(trial: TrialConfig) -> dict[str, Any]:
    """Settings that a trial's result depends on; where nothing is learned, those of learning do not count."""
    method = METHODS.get(trial.method)
    learning = {"sac", "num_env_steps", "curve_every", "curve_episodes"}
    return trial.model_dump(mode="json", exclude=learning if method and method.player else None)


def _read(path: Path) -> Result:
    result = read_json(path)
    found = result.get("format_version")
    if found != FORMAT_VERSION:
        raise TandemError(
            f"{path}: format version {found!r}, this program reads {FORMAT_VERSION}; name another directory"
        )
    return result
