"""Settings with which a run may go on: those that it was begun with, but for a few."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from service.config import Config, load_config, parse_config
from service.errors import ConfigError
from service.io.errors import CheckpointError
from service.io.run_directory import RunDirectory
from service.io.study_directory import StudyDirectory

RESUMABLE = ("run.", "learner.num_learners=", "learner.alice.learning_rate=", "learner.bob.learning_rate=")
"""What an override of a resumed run may begin with: nothing that its past would have to be made again for."""
_NUM_LEARNERS = "learner.num_learners"


def resumed_config(directory: RunDirectory | StudyDirectory, overrides: list[str], file: Path | None = None) -> Config:
    """The configuration to resume a run with: the saved one, where only ``RESUMABLE`` may be changed.

    Args:
        directory: of the run, or of a study.
        overrides: ``run.a=b`` strings, or learning rates; others may only say what the run has.
        file: YAML that, with ``overrides``, says the same as the saved one outside ``run`` but for the number of
            learners; what it says there comes before ``overrides``.

    Raises:
        ConfigError: no run there, an override of anything else, or a file that says otherwise.
    """
    saved = directory.read_config()
    fixed = [override for override in overrides if not override.startswith(RESUMABLE)]
    for override in fixed:
        if not _says(saved, directory, override):
            raise ConfigError(
                f"override {override!r}: a resumed run keeps its configuration; only run.*, the learning rates and "
                "learner.num_learners may change, for example run.total_env_steps"
            )
    if file is not None:
        given = load_config(file, fixed, recorded=True)  # maybe the one the run was begun with, by an earlier version
        _check_same_outside_run(saved, given, file)
        named = given.run.model_dump(mode="json", exclude_unset=True)
        free = {f"run.{key}": value for key, value in named.items()}
        if _NUM_LEARNERS.rpartition(".")[2] in given.learner.model_fields_set:
            free[_NUM_LEARNERS] = given.learner.num_learners
        overrides = [f"{key}={json.dumps(value)}" for key, value in free.items()] + overrides
    return directory.read_config(overrides)


def _says(saved: Config, directory: RunDirectory | StudyDirectory, override: str) -> bool:
    try:
        return directory.read_config([override]) == saved
    except ConfigError:
        return False


def _check_same_outside_run(saved: Config, given: Config, file: Path) -> None:
    left, right = (dict(_leaves(config.model_dump(mode="json", exclude={"run"}))) for config in (saved, given))
    for key in sorted((left.keys() | right.keys()) - {_NUM_LEARNERS}):
        if left.get(key) != right.get(key):
            raise ConfigError(
                f"{file}: {key} = {right.get(key)!r}, but the run has {left.get(key)!r}; a resumed run keeps its "
                "configuration: leave out --config, or start another run without --resume"
            )


def _leaves(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def changed_settings(saved: dict[str, Any], config: Config, directory: Path) -> dict[str, tuple[Any, Any]]:
    """Settings in which a run differs from what its checkpoint was made with: what they were, and what they are.

    Args:
        saved: configuration in the checkpoint, of this or an earlier version.
        config: to go on with.
        directory: of the run, named in errors.

    Raises:
        CheckpointError: a setting that may not change.
    """
    try:
        before = parse_config(saved, where="the checkpoint", recorded=True)
    except ConfigError as error:
        raise CheckpointError(f"{directory}: {error}; the tandem that wrote it can go on with it") from None
    was, now = (dict(_leaves(each.model_dump(mode="json"))) for each in (before, config))
    changed = {key: (was.get(key), now.get(key)) for key in {**was, **now} if was.get(key) != now.get(key)}
    for key, (old, new) in changed.items():
        if not f"{key}=".startswith(RESUMABLE):
            raise CheckpointError(
                f"{directory}: {key} is {new!r} in config.yaml, but its newest checkpoint was made with {old!r}; put "
                "that back, or start another run without --resume"
            )
    return changed
