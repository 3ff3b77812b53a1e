"""What was learned downstream, ready to act: loaded from a training's directory or a registry, and published there.

An orchestrator is of little use without the primitives it sets the weights of. Both places say which those are, by a
reference and a digest of their parameters; other ones are refused.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import service
from service.actors.evaluation import DeterministicPolicy
from service.config import WorldConfig
from service.downstream.directory import TrainingDirectory, read_trial
from service.downstream.files import read_json, read_result
from service.downstream.inputs import num_inputs
from service.downstream.methods import METHODS, Method, Trained, digest_of, find_method
from service.downstream.policy import LearnedPolicy, load_policy, read_policy
from service.downstream.settings import validate
from service.envs.observations import layouts
from service.envs.tasks import find_task
from service.errors import TandemError
from service.io.errors import StorageError
from service.io.run_directory import Published, RunDirectory
from service.primitives.bundled import BUNDLED, find_version, is_bundled
from service.primitives.loading import ORCHESTRATOR
from service.primitives.publishing import newest_if_same
from service.registry.exported import is_exported
from service.registry.manifest import Manifest
from service.registry.names import Version, check_name
from service.registry.registry import Registry
from service.types import FloatArray

_logger = logging.getLogger(__name__)
_SHOWN = 12
"""Characters of a digest in messages."""


@dataclass(frozen=True, slots=True)
class Orchestrator:
    """A policy of a downstream task, with the primitives or skills that it acts with.

    It keeps the step before, so call ``begin`` before new episodes.
    """

    label: str
    """Where it comes from, such as ``push-orchestrator@1``."""
    name: str
    """What it is called elsewhere, where paths of this machine mean nothing: its version, or its trial."""
    task: str
    """Name of the task it was trained on, such as ``push``."""
    method: str
    """Name of the method it was trained with, such as ``ours-her``."""
    policy: DeterministicPolicy
    trained: Trained
    """What it acts with; of a method that takes nothing, what says in which world it plays."""
    manifest: Manifest | None = None
    """Its manifest in the registry; None for that of a training's directory."""

    @property
    def world(self) -> WorldConfig:
        """The world of its task."""
        return find_task(self.task).world_from(self.trained.config.world)

    def begin(self) -> None:
        """Forget the last step: new episodes begin."""
        if isinstance(self.policy, LearnedPolicy):
            self.policy.begin()

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        """(N, O) positions and goal, such as (N, 14), to actions (N, 4).

        Raises:
            PolicyError: another shape, or another N than in the step before.
        """
        return self.policy.act_deterministic(observation)


def method_of(reference: str, place: Path) -> Method | None:
    """The method of a downstream training, or of a version that one has published; None for what is neither.

    Args:
        reference: as of ``load_orchestrator``, or of something else.
        place: directory of the registry to look in first.

    Raises:
        TandemError: no such version, or a damaged training.
    """
    path = Path(reference)
    if not is_exported(path) and (path.is_dir() or "/" in reference):
        file = TrainingDirectory(path).trial_file
        return find_method(read_trial(read_json(file), file).method) if file.exists() else None
    found, version = find_version(reference, place)
    spaces: dict[str, Any] = dict(found.manifest(str(version)).spaces)
    return find_method(str(spaces.get("method"))) if spaces.get("kind") == ORCHESTRATOR else None


def load_orchestrator(reference: str, place: Path, registry: Path | str, primitives: str | None = None) -> Orchestrator:
    """Load what a training has learned; see ``service.load_policy``.

    Args:
        reference: directory of a training, a published version, or the directory of an exported one.
        place: directory of the registry that has the version.
        registry: directory or URL of the one in which to look for what it acts with.
        primitives: what it acts with, where that has moved.

    Raises:
        TandemError: nothing there by that reference, something else, damaged, not finished, or without the primitives
            or skills it was trained with.
    """
    exported = is_exported(Path(reference))
    if Path(reference).is_dir() and not exported:
        return _load_training(Path(reference), registry, primitives)
    if "/" in reference and not exported:
        raise TandemError(f"{reference}: no such directory of a training; for published ones write NAME@ALIAS")
    found, version = find_version(reference, place)
    manifest, parameters = found.load(str(version))
    label = f"{version} (bundled)" if is_bundled(found) else str(version)
    spaces: dict[str, Any] = dict(manifest.spaces)
    if (kind := spaces.get("kind", "primitives")) != ORCHESTRATOR:
        raise TandemError(
            f"{label} holds {kind}, not an orchestrator: load them by service.load_{kind}, or name what tandem "
            "downstream publish has published"
        )
    try:
        method, task = find_method(spaces["method"]), spaces["task"]
        recorded = {"name": spaces["primitives"], "digest": spaces["primitives_digest"]}
        hold_steps = int(spaces["hold_steps"])
    except (KeyError, TypeError, ValueError) as error:
        raise TandemError(f"{label}: its manifest lacks {error}; publish it again") from None
    trained = _find_frozen(label, method, recorded, registry, primitives)
    policy = LearnedPolicy(parameters, method, trained, hold_steps)
    return Orchestrator(label, str(version), task, spaces["method"], policy, trained, manifest)


def publish_orchestrator(
    run: Path, name: str, registry: Path | str, primitives: str | None = None
) -> tuple[Orchestrator, Version]:
    """Publish what a training has learned, with its result, and with the reference and digest of what it acts with.

    Args:
        run: directory of the training, which has ended.
        name: of what is published, such as ``push-orchestrator``; not the name of primitives.
        registry: directory to publish in.
        primitives: published version that it acts with, if that has another name than when it was trained.

    Returns:
        The orchestrator, and its new version, or the newest one where that has the same parameters already.

    Raises:
        TandemError: no orchestrator, primitives that are not published or others than it was trained with, a name
            that is that of something else; nothing was written.
    """
    found = _load_training(run, registry, primitives)
    acts_with = check_publishable(found.method, found.trained, name, registry)
    target = Registry(Path(registry))
    directory = TrainingDirectory(run)
    _, parameters, hold_steps = read_policy(directory.policy_file, found.trained)
    result = read_result(directory.result_file)
    trial = read_trial(read_json(directory.trial_file), directory.trial_file)
    world = found.trained.config.world
    spaces = {
        **layouts(world).spaces,
        "kind": ORCHESTRATOR,
        "task": found.task,
        "task_version": trial.task_version,
        "method": found.method,
        "hold_steps": hold_steps,
        "primitives": acts_with.reference,
        "primitives_digest": digest_of(found.trained),
    }
    numbers = {f"evaluation/{key}": value for key, value in result["evaluation"].items() if _is_number(value)}
    published = newest_if_same(target, name, parameters) or target.publish(
        name,
        parameters,
        spaces=spaces,
        normalisation={"made_by": num_inputs.__module__, "num_inputs": num_inputs(layouts(world))[1]},
        config={"trial": trial.model_dump(mode="json"), "world": world.model_dump(mode="json")},
        metrics={**numbers, "env_steps": float(result["env_steps"])},
    )
    try:
        RunDirectory(run).write_published(Published(str(published), target.manifest(str(published)).blob_sha256))
    except StorageError as error:  # it is published all the same
        _logger.warning("the training does not know what it was published as: %s", error)
    return found, published


def check_publishable(method: str, trained: Trained, name: str, registry: Path | str) -> Manifest:
    """Assert that what a method learns with primitives or skills could be published by a name.

    Returns:
        The manifest of what it acts with.

    Raises:
        TandemError: a registry that cannot be written, a method that learns no orchestrator, primitives that are not
            published, or a name that is no name, or that of something else.
    """
    if service.is_service(registry):
        raise TandemError(f"{registry} is read only: publish in a directory (--registry DIR), and serve that")
    target = Registry(Path(registry))
    target.check_writable()
    if METHODS[method].takes is None or METHODS[method].player is not None:
        raise TandemError(f"the method {method} learns no orchestrator: there is nothing to publish")
    if trained.manifest is None:
        raise TandemError(
            f"an orchestrator for {trained.label}, which is no published version, cannot be published: publish that "
            "first, and name it with --primitives NAME@VERSION"
        )
    for place in (target, Registry(BUNDLED)):  # of either, NAME@latest would come to mean the orchestrator
        for version in place.versions(check_name(name))[-1:]:
            if (kind := place.manifest(str(version)).spaces.get("kind", "primitives")) != ORCHESTRATOR:
                raise TandemError(f"{name} is the name of {kind} already: give the orchestrator one of its own")
    return trained.manifest


def _load_training(run: Path, registry: Path | str, primitives: str | None) -> Orchestrator:
    directory = TrainingDirectory(run)
    if not directory.trial_file.exists():
        if RunDirectory(run).config_file.exists():
            raise TandemError(f"{run} is a run of tandem pretrain, not a downstream training: name it as --primitives")
        raise TandemError(f"{run} holds no downstream training; name the directory of a tandem downstream train")
    recorded = read_json(directory.trial_file)
    trial = read_trial(recorded, directory.trial_file)
    method = find_method(trial.method)
    if method.player is None and not directory.policy_file.exists():
        if directory.result_file.exists():
            raise TandemError(f"{run} has ended, but its {directory.policy_file.name} is gone: train it again")
        raise TandemError(f"{run} has not ended: continue it with tandem downstream train --resume --run-dir {run}")
    wanted = recorded.get("primitives")
    trained = _find_frozen(str(run), method, wanted, registry, primitives)
    if wanted is None and validate(WorldConfig, recorded.get("world")) != trained.config.world:
        raise TandemError(
            f"{run} was trained in another world than that of {trained.label}: name primitives of that world with "
            "--primitives"
        )
    policy = method.player(trained) if method.player is not None else load_policy(directory.policy_file, trained)
    return Orchestrator(str(run), trial.name, trial.task, trial.method, policy, trained)


def _find_frozen(
    label: str, method: Method, wanted: dict[str, Any] | None, registry: Path | str, named: str | None
) -> Trained:
    """The primitives or skills of that digest: where they are said to be, in the registry, or what is bundled."""
    load = service.load_skills if method.takes == "skills" else service.load_primitives
    if wanted is None:
        return load(named, registry) if named is not None else service.load_primitives(registry=registry)
    try:
        name, wanted_digest = str(wanted["name"]), str(wanted["digest"])
    except (KeyError, TypeError):
        raise TandemError(f"{label} does not say by name and digest what it acts with; train it again") from None
    places = [(named, registry)] if named is not None else [(name, registry), (name, BUNDLED)]
    problems = []
    for reference, place in places:
        try:
            trained = load(reference, place)
        except TandemError as error:
            problems.append(str(error))
            continue
        digest = digest_of(trained)
        if digest == wanted_digest:
            return trained
        problems.append(f"{trained.label} has other parameters, digest {digest[:_SHOWN]}")
    raise TandemError(
        f"{label} acts with {name} of digest {wanted_digest[:_SHOWN]}, which is not here: {problems[0]}; "
        "name it with --primitives, or the registry that has it with --registry"
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
