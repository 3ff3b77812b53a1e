"""Settings with which a run may go on: those that it was begun with, but for a few."""

from __future__ import annotations

import json
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from service.base.errors import CheckpointError, ConfigError
from service.config import Config, load_config
from service.config.tree import apply_override, leaves
from service.store.run_directory import RunDirectory


def resumed_config(directory: RunDirectory | Path, overrides: list[str], file: Path | None = None) -> Config:
    """The configuration to resume a run with: the saved one, changed only where its class says it is ``resumable``.

    Args:
        directory: of the run; or the file with the configuration of a run of a study.
        overrides: ``a.b=c`` strings.
        file: YAML that may say again what the run was begun with; ``overrides`` come after it.

    Raises:
        ConfigError: no run there, or anything else is to be another.
    """
    read = partial(load_config, directory) if isinstance(directory, Path) else directory.read_config
    saved = read()
    try:
        given = read(overrides) if file is None else load_config(file, overrides, saved.code, saved.name)
    except ConfigError:
        tree: dict[str, Any] = {}
        for override in overrides:
            apply_override(tree, override)
        if (method := tree.get("method", saved.method)) != saved.method:  # whose keys are others
            raise ConfigError(f"the run learns by {saved.method}, not by {method}: name that, or another run") from None
        if "task" in tree and "task" not in type(saved).model_fields:
            raise ConfigError(
                f"the run learns by {saved.method}, not the task {tree['task']}: leave that out, or name another run"
            ) from None
        raise
    if type(given) is type(saved):
        given = given.as_in(saved)
    for key, (old, new) in _differences(saved.model_dump(mode="json"), given).items():
        if not f"{key}=".startswith(saved.resumable):
            may = " and ".join(each.rstrip("=") if each.endswith("=") else f"{each}*" for each in saved.resumable)
            raise ConfigError(
                f"{key} = {new!r}, but the run has {old!r}; a resumed run keeps its configuration: only {may} may "
                "change; leave it out, or start another run without --resume"
            )
    named = leaves(given.model_dump(mode="json", exclude_unset=True))
    return read([f"{key}={json.dumps(value)}" for key, value in named if f"{key}=".startswith(saved.resumable)])


def changed_settings(saved: dict[str, Any], config: Config, directory: Path) -> dict[str, tuple[Any, Any]]:
    """Settings in which a run differs from what its checkpoint was made with: what they were, and what they are.

    Args:
        saved: configuration in the checkpoint.
        config: to go on with.
        directory: of the run, named in errors.

    Raises:
        CheckpointError: a setting that may not change.
    """
    with suppress(ValidationError):  # a key that is gone may be read still; else it is one of the differences
        saved = type(config).model_validate(saved).model_dump(mode="json")
    changed = _differences(saved, config)
    for key, (old, new) in changed.items():
        if not f"{key}=".startswith(config.resumable):
            raise CheckpointError(
                f"{directory}: {key} is {new!r} in config.yaml, but its newest checkpoint was made with {old!r}; put "
                "that back, or start another run without --resume"
            )
    return changed


def _differences(saved: dict[str, Any], given: Config) -> dict[str, tuple[Any, Any]]:
    """By key the values in two configurations, where they differ; None where one has no such key."""
    was, now = dict(leaves(saved)), dict(leaves(given.model_dump(mode="json")))
    return {key: (was.get(key), now.get(key)) for key in {**was, **now} if was.get(key) != now.get(key)}
