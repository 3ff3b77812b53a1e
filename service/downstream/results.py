"""The table's directory: one JSON file per trial, written when the trial has ended, never overwritten."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from service.downstream.directory import read_trial
from service.downstream.files import Result, made_with, read_result, to_json
from service.downstream.methods import METHODS, provenance
from service.downstream.settings import TrialConfig, differences
from service.errors import TandemError
from service.io.files import os_errors, write_exclusive
from service.primitives.loading import Trained


class ResultsDirectory:
    """The results of trials, by their names."""

    def __init__(self, path: Path) -> None:
        """Name the directory, which need not exist; nothing is read before it is asked for."""
        self.path = path

    def find(self, trial: TrialConfig, trained: Trained) -> Result | None:
        """Find the result of a trial with these primitives; None where it has not been run.

        Raises:
            TandemError: the file is damaged, of another format version, or of other settings or primitives.
        """
        path = self.path / f"{trial.name}.json"
        if not path.exists():
            return None
        result = read_result(path)
        wanted = settings_of(trial) | provenance(trained, trial.method)
        if wrong := differences(settings_of(read_trial(result, path)) | made_with(result), wanted):
            raise TandemError(f"{path} is of {'; '.join(wrong)}: give the same settings, or name another directory")
        return result

    def missing(self, trials: Iterable[TrialConfig], trained: Trained) -> list[TrialConfig]:
        """List the trials that have to be run; every file is checked before any is.

        What is in the directory and what is asked for comes onto one page: of the same world, the tasks of a method and
        seed with the same primitives or skills, and the seeds of a method on a task with the same settings.

        Raises:
            TandemError: as for ``find``; or the page would mix what cannot be compared.
        """
        missing = [trial for trial in trials if self.find(trial, trained) is None]
        asked = {(trial.method, trial.seed) for trial in missing}
        of_all_seeds = {(each.method, each.task): (f"{each.name}, asked for,", settings_of(each)) for each in missing}
        for path in sorted(self.path.glob("*.json")):
            result = read_result(path)
            trial = read_trial(result, path)
            same = ("primitives", "world") if (trial.method, trial.seed) in asked else ("world",)
            found, wanted = (
                {key: tree[key] for key in same} for tree in (made_with(result), provenance(trained, trial.method))
            )
            if wrong := differences(found, wanted):
                raise TandemError(f"{path} is of {'; '.join(wrong)}: name another directory, or move it away")
            other, settings = of_all_seeds.setdefault((trial.method, trial.task), (str(path), settings_of(trial)))
            if wrong := differences(settings_of(trial) | {"seed": 0}, settings | {"seed": 0}):
                raise TandemError(f"{path} and {other} are seeds of one method, but of {'; '.join(wrong)}")
        return missing

    def add(self, trial: TrialConfig, result: Result) -> None:
        """Keep a result, in one step.

        Raises:
            TandemError: there is one already, or the disk is full.
        """
        path = self.path / f"{trial.name}.json"
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
        return [read_result(path) for path in sorted(self.path.glob("*.json"))]


def settings_of(trial: TrialConfig) -> dict[str, Any]:
    """Settings that a trial's result depends on; where nothing is learned, those of learning do not count."""
    method = METHODS.get(trial.method)
    without = set() if method and method.holds else {"skill_steps"}
    if method and method.player:
        without |= {"sac", "num_env_steps", "curve_every", "curve_episodes", "reward_margin_m"}
    return trial.model_dump(mode="json", exclude=without)
