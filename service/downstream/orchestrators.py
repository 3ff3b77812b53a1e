"""What was learned downstream, published.

An orchestrator is of little use without the primitives it sets the weights of. Its version says which those are, by a
reference and a digest of their parameters; other ones are refused when it is loaded.
"""

from __future__ import annotations

import logging
from pathlib import Path

from service.downstream.directory import TrainingDirectory, read_trial
from service.downstream.files import read_json, read_result
from service.downstream.methods import METHODS
from service.envs.observations import layouts
from service.errors import TandemError
from service.io.errors import StorageError
from service.io.run_directory import Published, RunDirectory
from service.primitives.bundled import BUNDLED
from service.primitives.learned import LearnedPolicy, num_inputs
from service.primitives.loading import ORCHESTRATOR, Trained, load
from service.primitives.publishing import newest_if_same
from service.registry.manifest import Manifest
from service.registry.names import Version, check_name, is_service
from service.registry.registry import Registry

_logger = logging.getLogger(__name__)


def publish_orchestrator(
    run: Path, name: str, registry: Path | str, primitives: str | None = None
) -> tuple[Trained, Version]:
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
    target, directory = _writable(registry), TrainingDirectory(run)
    found = load(str(run), registry, primitives)
    if not directory.trial_file.exists():
        raise TandemError(
            f"{found.label} is no directory of a downstream training; tandem downstream publish needs one"
        )
    trial = read_trial(read_json(directory.trial_file), directory.trial_file)
    acts_with = check_publishable(trial.method, found.trained, name, registry)
    assert isinstance(found.policy, LearnedPolicy)
    assert found.trained is not None
    world, result = found.config.world, read_result(directory.result_file)
    spaces = {
        **layouts(world).spaces,
        "kind": ORCHESTRATOR,
        "task": trial.task,
        "task_version": trial.task_version,
        "method": trial.method,
        "hold_steps": found.policy.hold_steps,
        "primitives": acts_with.reference,
        "primitives_digest": found.trained.digest,
    }
    numbers = {f"evaluation/{key}": value for key, value in result["evaluation"].items() if _is_number(value)}
    published = newest_if_same(target, name, found.parameters) or target.publish(
        name,
        found.parameters,
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


def check_publishable(method: str, trained: Trained | None, name: str, registry: Path | str) -> Manifest:
    """Assert that what a method learns with primitives or skills could be published by a name.

    Returns:
        The manifest of what it acts with.

    Raises:
        TandemError: a registry that cannot be written, a method that learns no orchestrator, primitives that are not
            published, or a name that is no name, or that of something else.
    """
    target = _writable(registry)
    if trained is None or METHODS[method].takes is None or METHODS[method].player is not None:
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


def _writable(registry: Path | str) -> Registry:
    if is_service(registry):
        raise TandemError(f"{registry} is read only: publish in a directory (--registry DIR), and serve that")
    target = Registry(Path(registry))
    target.check_writable()
    return target


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
