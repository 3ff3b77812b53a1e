"""Publishing a trained Bob, or skills: measured, published once, with the version training began from as parent."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.actors.coverage import NUM_SKILLS, skill_paths, visited_share
from service.actors.evaluation import REPORTED_SEED, evaluated_goals, success_metrics
from service.base import tensors
from service.base.errors import StorageError, TandemError
from service.config import Config
from service.config.skills import SkillDiscoveryConfig
from service.config.task import TaskConfig
from service.envs.observations import POSITIONS, SPACES, layouts
from service.envs.tasks import find_task
from service.policies.frozen_skills import FrozenSkills
from service.policies.learned_policy import num_inputs
from service.policies.numpy_policy import numpy_bob
from service.policies.parameters import Parameters
from service.registry.bundled import BUNDLED, find_version
from service.registry.names import Version, is_service
from service.registry.registry import Registry, sha256_of
from service.store.run_directory import Published, RunDirectory


def measure_bob(config: Config, parameters: Parameters) -> dict[str, float]:
    """Bob's success rates without noise on every kind of goals, by metric; the goals are not those of the run.

    Where his worlds are drawn from ranges, also in the nominal one.
    """
    nominal = config.model_copy(update={"world": config.world.nominal})
    metrics: dict[str, float] = {}
    for world, prefix in ((config, ""), (nominal, "nominal_")):
        if prefix and world == config:
            break
        found = success_metrics(
            numpy_bob(parameters),
            world,
            evaluated_goals(config.world, config.success_distance_m),
            config.run.final_episodes,
            seed=REPORTED_SEED,
            num_threads=config.run.num_threads,
        )
        metrics |= {name.replace("/", f"/{prefix}"): value for name, value in found.items()}
    return metrics


def measure_skills(config: SkillDiscoveryConfig, parameters: Parameters, seed: int = REPORTED_SEED) -> dict[str, float]:
    """Share of the workspace's table that random skills of a seed move the object over, without noise."""
    paths = skill_paths(
        FrozenSkills(parameters, config.skills),
        config.world,
        num_skills=NUM_SKILLS,
        num_steps=config.skills.episode_steps,
        seed=seed,
        num_threads=config.run.num_threads,
    )
    return {"coverage": visited_share(paths, config.world.workspace)}


def publish_run(
    directory: RunDirectory, registry: Registry, config: Config, parameters: Parameters, metrics: dict[str, float]
) -> Version:
    """Publish what a run has learned, and note it in the run directory: of what it publishes next, this is the parent.

    Returns:
        The new version; or the newest one of that name, or the one that this run published last, where that has the
        same parameters already.

    Raises:
        StorageError: see ``Registry.publish``; or the run directory cannot be written.
    """
    parent = _published_before(directory, registry)
    candidates = registry.versions(config.name)[-1:]
    if parent is not None and parent.name == config.name:
        candidates.append(parent)  # others may have published under this name since
    version = next((each for each in candidates if _has(registry, each, parameters)), None)
    if version is None:
        known = directory.history
        history = known.model_dump(mode="json") if known.events else None
        version = publish(registry, config, parameters, metrics, parent=parent, history=history)
    elif (last := directory.read_published()) is None or last.version != str(version):
        registry.complete(version)  # whoever published it may have been cut off
    directory.write_published(Published(str(version), registry.manifest(str(version)).blob_sha256))
    return version


def publish(
    registry: Registry,
    config: Config,
    parameters: Parameters,
    metrics: dict[str, float],
    *,
    parent: Version | None = None,
    history: Mapping[str, Any] | None = None,
) -> Version:
    """Publish what a run has learned, with everything a user needs; the spaces in the manifest say what it is.

    Raises:
        StorageError: see ``Registry.publish``.
    """
    return registry.publish(
        config.name,
        parameters,
        **_described(config),
        config=config.model_dump(mode="json"),
        metrics=metrics,
        parent=parent,
        history=history,
    )


def check_makes(config: Config) -> None:
    """Check that a run makes what can be published.

    Raises:
        TandemError: it makes nothing, or a Bob without primitives.
    """
    if config.makes is None:
        raise TandemError(f"a run of the method {config.method} makes nothing that can be published")
    if not config.publishable:
        raise TandemError("a Bob without primitives (policy.monolithic_bob) cannot be published")


def check_publishable(config: Config, registry: Path | str) -> None:
    """Check that what a run makes can be published in a registry.

    Raises:
        TandemError: see ``check_makes``; or a registry that is only read; or a name that is that of something else; or,
            of a policy of a task, primitives that are not published.
    """
    check_makes(config)
    if is_service(registry):
        raise TandemError(f"{registry} is read only: publish in a directory (--registry DIR), and serve that")
    target = Registry(Path(registry))
    target.check_writable(config.name)
    for place in (target, Registry(BUNDLED)):  # of either, NAME@latest would come to mean something else
        for version in place.versions(config.name)[-1:]:
            with contextlib.suppress(StorageError):  # a damaged version is mended by publishing again
                kind = place.manifest(str(version)).spaces.get("kind", "primitives")
                if config.makes != kind:
                    what = f"an {kind}" if kind == "orchestrator" else kind
                    raise TandemError(f"{config.name} is the name of {what} already: choose another name")
    if not isinstance(config, TaskConfig):
        return
    if config.primitives_digest is None:
        raise TandemError(f"the method {config.method} acts with no primitives: there is nothing to publish")
    if Path(config.primitives).is_absolute():
        raise TandemError(
            f"an orchestrator for {config.primitives}, which is no published version, cannot be published: publish "
            "that first, and name it by --primitives NAME@VERSION"
        )


def _described(config: Config) -> dict[str, Any]:
    """Spaces and normalisation in the manifest of what a run makes."""
    seen = layouts(config.world)
    if isinstance(config, TaskConfig):
        spaces = {
            **seen.spaces,
            "kind": "orchestrator",
            "task": config.task,
            "task_version": config.task_version,
            "method": config.method,
            "hold_steps": 1,  # earlier versions could hold a skill for longer
            "primitives": config.primitives,
            "primitives_digest": config.primitives_digest,
        }
        if (task := find_task(config.task, config.code, config.task_world)).code:
            spaces["own_task"] = task.data()
        return {
            "spaces": spaces,
            "normalisation": {"made_by": num_inputs.__module__, "num_inputs": num_inputs(seen)[1]},
        }
    if isinstance(config, SkillDiscoveryConfig):
        shared = {name: size for name, size in SPACES.items() if name != "observation"}
        normalisation, spaces = POSITIONS.normalisation, {**shared, "kind": "skills", "skill": config.skills.size}
    else:
        normalisation, spaces = seen.bob.normalisation, seen.spaces
    constants = {"offset": normalisation.offset.tolist(), "scale": normalisation.scale.tolist()}
    return {"spaces": spaces, "normalisation": constants}


def _has(registry: Registry, version: Version, parameters: Parameters) -> bool:
    """Whether a version of this registry has these parameters; a damaged one is mended by publishing again."""
    with contextlib.suppress(StorageError):
        manifest, _ = registry.load(str(version))
        return manifest.blob_sha256 == sha256_of(tensors.encode(parameters))
    return False


def _published_before(directory: RunDirectory, registry: Registry) -> Version | None:
    """The version this run published last, or began from, if readers of this registry find that one by its name."""
    last = directory.read_published()
    with contextlib.suppress(StorageError):
        if last is not None:
            found, version = find_version(last.version, registry.root)
            if found.manifest(str(version)).blob_sha256 == last.blob_sha256:
                return version
    return None
