"""Settings with which a run may go on: those that it was begun with, but for a few."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from service.base.errors import CheckpointError, ConfigError
from service.config import Config, load_config
from service.config.tree import leaves
from service.runs.study_file import SavedConfig
from service.store.run_directory import RunDirectory


def resumed_config(directory: RunDirectory | SavedConfig, overrides: list[str], file: Path | None = None) -> Config:
    """The configuration to resume a run with: the saved one, changed only where its class says it is ``resumable``.

    Args:
        directory: of the run; or what a run of a study begins with.
        overrides: ``run.a=b`` strings, or learning rates; others may only say what the run has.
        file: YAML that, with ``overrides``, says the same as the saved one outside ``run``; what it says there comes
            before ``overrides``.

    Raises:
        ConfigError: no run there, an override of anything else, or a file that says otherwise.
    """
    saved = directory.read_config()
    fixed = [override for override in overrides if not override.startswith(saved.resumable)]
    for override in fixed:
        if not _says(saved, directory, override):
            raise ConfigError(
                f"override {override!r}: a resumed run keeps its configuration; only {_resumable(saved)} may change, "
                "for example run.total_env_steps"
            )
    if file is not None:
        given = load_config(file, fixed)
        _check_same_outside_run(saved, _as_in(saved, given), file)
        named = given.run.model_dump(mode="json", exclude_unset=True)
        overrides = [f"run.{key}={json.dumps(value)}" for key, value in named.items()] + overrides
    return directory.read_config([override for override in overrides if override not in fixed])


def _resumable(config: Config) -> str:
    return " and ".join(key.rstrip("=") if key.endswith("=") else f"{key}*" for key in config.resumable)


def _says(saved: Config, directory: RunDirectory | SavedConfig, override: str) -> bool:
    try:
        return _as_in(saved, directory.read_config([override])) == saved
    except ConfigError:
        return False


def _as_in(saved: Config, given: Config) -> Config:
    return given.as_in(saved) if type(given) is type(saved) else given


def _check_same_outside_run(saved: Config, given: Config, file: Path) -> None:
    left, right = (dict(leaves(config.model_dump(mode="json", exclude={"run"}))) for config in (saved, given))
    for key in sorted(left.keys() | right.keys()):
        if left.get(key) != right.get(key):
            raise ConfigError(
                f"{file}: {key} = {right.get(key)!r}, but the run has {left.get(key)!r}; a resumed run keeps its "
                "configuration: leave out --config, or start another run without --resume"
            )


def resumable_settings(config: Config) -> list[str]:
    """All that may differ from what a run was begun with, as overrides."""
    settings = leaves(config.model_dump(mode="json"))
    return [f"{key}={json.dumps(value)}" for key, value in settings if f"{key}=".startswith(config.resumable)]


def changed_settings(saved: dict[str, Any], config: Config, directory: Path) -> dict[str, tuple[Any, Any]]:
    """Settings in which a run differs from what its checkpoint was made with: what they were, and what they are.

    Args:
        saved: configuration in the checkpoint.
        config: to go on with.
        directory: of the run, named in errors.

    Raises:
        CheckpointError: a setting that may not change.
    """
    was, now = dict(leaves(saved)), dict(leaves(config.model_dump(mode="json")))
    changed = {key: (was.get(key), now.get(key)) for key in {**was, **now} if was.get(key) != now.get(key)}
    for key, (old, new) in changed.items():
        if not f"{key}=".startswith(config.resumable):
            raise CheckpointError(
                f"{directory}: {key} is {new!r} in config.yaml, but its newest checkpoint was made with {old!r}; put "
                "that back, or start another run without --resume"
            )
    return changed
