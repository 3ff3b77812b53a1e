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
from service.types import Array
from service.world_config import WorldConfig

_NETWORKS = ("policy", "value")


@dataclass(frozen=True, slots=True)
class Start:
    """What a run begins from."""

    label: str
    networks: Mapping[str, Mapping[str, Array]]
    """By ``bob/policy``, ``bob/value``, ``alice/policy`` and ``alice/value``; of a published version only the first."""
    world: WorldConfig
    """That policies were trained in, which says what they saw."""
    published: Published | None
    """The version, which is the parent of what the run publishes."""


def read_start(reference: str, registry: Path, config: Config) -> Start:
    """Read what a run of ``config`` shall begin from.

    Args:
        reference: NAME, NAME@VERSION, NAME@ALIAS or a run directory.
        registry: directory to look in first; then what comes with the package.
        config: of the new run.

    Raises:
        TandemError: nothing there, skills, or a run of skills.
    """
    if config.skills is not None:
        raise TandemError("--from is for self-play; skill discovery begins anew: leave it out")
    if Path(reference).is_dir():
        directory = RunDirectory(Path(reference))
        before, published = directory.read_config(), None
        _check_self_play(before, reference)
        saved = CheckpointStore(directory.checkpoints, keep=1).load_latest().arrays
        learner = split_parts(split_parts(saved)["learner"])
        networks: Mapping[str, Mapping[str, Array]] = {
            f"{player}/{network}": split_parts(learner[player])[network]
            for player in ("bob", "alice")
            for network in _NETWORKS
        }
    elif "/" in reference:
        raise TandemError(f"--from {reference}: no such run directory; for published versions write NAME@ALIAS")
    else:
        found, version = find_version(reference, registry)
        manifest, tensors = found.load(str(version))
        before = parse_config(manifest.config, where=f"the manifest of {reference}", recorded=True)
        _check_self_play(before, reference)
        networks, published = {"bob/policy": tensors}, Published(str(version), manifest.blob_sha256)
    return Start(reference, networks, before.world, published)


def _check_self_play(config: Config, reference: str) -> None:
    if config.skills is not None:
        raise TandemError(
            f"--from {reference}: these are skills of {config.skills.method}; name primitives, or a run of them"
        )
