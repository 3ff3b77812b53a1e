"""Runs that begin from what another one has learned: a published version, or a run directory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from service.config import Config, parse_config
from service.errors import TandemError
from service.io.checkpoints import CheckpointStore
from service.io.run_directory import Published, RunDirectory
from service.io.tensors import split_parts
from service.primitives.bundled import find_version
from service.registry.exported import is_exported
from service.types import Array
from service.world_config import WorldConfig

_PLAYERS = ("bob", "alice")
_NETWORKS = ("policy", "value")


@dataclass(frozen=True, slots=True)
class Start:
    """What a run begins from."""

    reference: str
    """That finds the same again, from any directory: a version without an alias, or an absolute path."""
    networks: Mapping[str, Mapping[str, Array]]
    """By ``bob/policy``, ``bob/value``, ``alice/policy`` and ``alice/value``; of a published version, and of a run of
    distillation, only the first."""
    world: WorldConfig
    """That policies were trained in, which says what they saw."""
    published: Published | None
    """The version, which is the parent of what the run publishes."""


def read_start(reference: str, registry: Path, config: Config) -> Start:
    """Read what a run of ``config`` shall begin from.

    Args:
        reference: NAME, NAME@VERSION or NAME@ALIAS; a run directory, or the directory of an exported version.
        registry: directory to look in first; then what comes with the package.
        config: of the new run.

    Raises:
        TandemError: nothing there, skills, or a run of skills.
    """
    if config.skills is not None:
        raise TandemError("--from is for self-play; skill discovery begins anew: leave it out")
    path, run = Path(reference), RunDirectory(Path(reference))
    if run.exists:
        before, published, found_again = run.read_config(), None, str(path.absolute())
        _check_self_play(before, reference)
        networks = _learned(run, before)
    elif "/" in reference and not is_exported(path):
        raise TandemError(f"--from {reference}: no such run directory; for published versions write NAME@ALIAS")
    else:
        found, version = find_version(reference, registry)
        manifest, tensors = found.load(str(version))
        before = parse_config(manifest.config, where=f"the manifest of {reference}", recorded=True)
        _check_self_play(before, reference)
        networks, published = {"bob/policy": tensors}, Published(str(version), manifest.blob_sha256)
        found_again = str(path.absolute()) if is_exported(path) else str(version)
    return Start(found_again, networks, before.world, published)


def _learned(directory: RunDirectory, config: Config) -> Mapping[str, Mapping[str, Array]]:
    """The networks of a run's newest checkpoint; distillation has Bob's policy alone."""
    parts = split_parts(CheckpointStore(directory.checkpoints, keep=1).load_latest().arrays)
    if not config.is_self_play:
        return {"bob/policy": parts["bob"]}
    learner = {player: split_parts(own) for player, own in split_parts(parts["learner"]).items()}
    return {f"{player}/{network}": learner[player][network] for player in _PLAYERS for network in _NETWORKS}


def _check_self_play(config: Config, reference: str) -> None:
    if config.skills is not None:
        raise TandemError(
            f"--from {reference}: these are skills of {config.skills.method}; name primitives, or a run of them"
        )
