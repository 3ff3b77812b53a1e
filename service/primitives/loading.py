"""Loading a Bob to evaluate, render or compose, from a registry or a run directory."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from service.baselines.frozen import FrozenSkills
from service.config import Config, parse_config
from service.errors import TandemError
from service.io.checkpoints import Checkpoint, CheckpointStore, read_checkpoint
from service.io.run_directory import RunDirectory
from service.policies.numpy_policy import NumpyGaussianPolicy, NumpyMCPPolicy, NumpyPolicy, numpy_bob
from service.policies.parameters import Parameters, PolicyError
from service.primitives.bundled import find_version, is_bundled
from service.registry.exported import is_exported
from service.registry.manifest import Manifest

SKILLS = "skills"
"""Part of a run's checkpoint that holds frozen skills, and kind in the spaces of their manifest."""

ORCHESTRATOR = "orchestrator"
"""Kind in the spaces of the manifest of a policy that was learned downstream."""


@dataclass(frozen=True, slots=True)
class TrainedSkills:
    """Frozen skills ready to act, and the configuration they were trained with."""

    label: str
    """Where they come from, such as ``panda-cube-lsd@1``."""
    skills: FrozenSkills
    config: Config
    manifest: Manifest | None = None
    """Their manifest in the registry; None for those of a run directory."""


@dataclass(frozen=True, slots=True)
class TrainedBob:
    """A Bob ready to act, and the configuration he was trained with."""

    label: str
    """Where he comes from, such as ``panda-cube@3``."""
    policy: NumpyPolicy
    parameters: Parameters = field(compare=False, repr=False)
    """That the policy was made of."""
    config: Config
    manifest: Manifest | None = None
    """His manifest in the registry; None for the Bob of a run directory."""

    @property
    def primitives(self) -> NumpyMCPPolicy:
        """The policy as primitives that can be composed.

        Raises:
            TandemError: this Bob is monolithic.
        """
        if not isinstance(self.policy, NumpyMCPPolicy):
            raise TandemError(f"{self.label} has no primitives: it was trained with policy.monolithic_bob")
        return self.policy


def load_bob(reference: str, registry: Path) -> TrainedBob:
    """Load NAME, NAME@ALIAS or NAME@VERSION from a registry, or the newest checkpoint of a run directory.

    Args:
        reference: of a version, or a run directory; or the directory of an exported version.
        registry: directory to look in first; a version or alias it does not have is looked up among what comes with
            the package.

    Raises:
        TandemError: neither a run directory nor a published version, or damaged.
    """
    label, config, tensors, manifest = _load(reference, registry, "bob")
    if config.skills is not None:
        raise TandemError(
            f"{label} holds skills of {config.skills.method}, not primitives: load them by service.load_skills, or "
            "name primitives"
        )
    if manifest is None:
        return TrainedBob(label, numpy_bob(tensors), tensors, config)
    try:
        return TrainedBob(label, NumpyMCPPolicy(tensors), tensors, config, manifest)
    except PolicyError as error:
        raise TandemError(f"{label} holds no primitives: {error}") from None


def load_skills(reference: str, registry: Path) -> TrainedSkills:
    """Load frozen skills; see ``load_bob``.

    Raises:
        TandemError: neither a run directory nor a published version, damaged, or no skills.
    """
    label, config, tensors, manifest = _load(reference, registry, SKILLS)
    if config.skills is None:
        raise TandemError(f"{label} holds primitives, not skills: load them by service.load_primitives, or name skills")
    try:
        return TrainedSkills(label, FrozenSkills(tensors, config.skills.method), config, manifest)
    except PolicyError as error:
        raise TandemError(f"{label} holds no skills: {error}") from None


def load_either(reference: str, registry: Path) -> TrainedBob | TrainedSkills:
    """Load a Bob or frozen skills, whichever is there; see ``load_bob``.

    Raises:
        TandemError: neither a run directory nor a published version, or damaged.
    """
    if _is_run(reference):
        skills = RunDirectory(Path(reference)).read_config().skills is not None
    elif "/" in reference and not is_exported(Path(reference)):
        skills = False  # what is wrong is said below
    else:
        found, version = find_version(reference, registry)
        skills = found.manifest(str(version)).spaces.get("kind") == SKILLS
    return load_skills(reference, registry) if skills else load_bob(reference, registry)


def _load(reference: str, registry: Path, part: str) -> tuple[str, Config, Parameters, Manifest | None]:
    """Label, configuration, parameters and manifest of a version; those of a run's ``part`` have no manifest."""
    if _is_run(reference):
        directory = RunDirectory(Path(reference))
        config = directory.read_config()
        fits = (part == SKILLS) == (config.skills is not None)  # or else the caller says what it is
        return reference, config, read_parameters(directory, part) if fits else {}, None
    if "/" in reference and not is_exported(Path(reference)):
        raise TandemError(f"{reference}: no such run directory; for published versions write NAME@ALIAS")
    found, version = find_version(reference, registry)
    manifest = found.manifest(str(version))
    if manifest.spaces.get("kind") == ORCHESTRATOR:
        raise TandemError(
            f"{version} is an orchestrator for the task {manifest.spaces.get('task')}, not primitives: load it by "
            "service.load_policy, or name it to tandem downstream evaluate, render or play"
        )
    manifest, tensors = found.load(str(version))
    config = parse_config(manifest.config, where=f"the manifest of {reference}", recorded=True)
    # two registries may both have a version 1: which one was meant must be seen
    label = f"{version} (bundled)" if is_bundled(found) else str(version)
    return label, config, tensors, manifest


def _is_run(reference: str) -> bool:
    """Whether a reference is that of a directory which holds a run, if anything."""
    return Path(reference).is_dir() and not is_exported(Path(reference))


def load_players(directory: RunDirectory) -> tuple[NumpyGaussianPolicy, NumpyPolicy]:
    """Alice and Bob of a run's newest checkpoint.

    Raises:
        TandemError: no usable checkpoint.
    """
    checkpoint = CheckpointStore(directory.checkpoints, keep=1).load_latest()
    return NumpyGaussianPolicy(_parameters(checkpoint, "alice")), numpy_bob(_parameters(checkpoint, "bob"))


def read_parameters(directory: RunDirectory, player: str) -> Parameters:
    """Parameters of ``alice``, ``bob`` or ``skills`` in a run's newest checkpoint."""
    return _parameters(CheckpointStore(directory.checkpoints, keep=1).load_latest(), player)


def read_stages(directory: RunDirectory) -> dict[int, Parameters]:
    """Parameters of Bob, or of skills, in a run's snapshots and its newest checkpoint, by env steps, in their order.

    Raises:
        TandemError: a snapshot is damaged, or there is no usable checkpoint.
    """
    part = "bob" if directory.read_config().skills is None else SKILLS
    store = CheckpointStore(directory.snapshots, keep=1)
    saved = [read_checkpoint(store.path(step)) for step in store.steps()]
    saved.append(CheckpointStore(directory.checkpoints, keep=1).load_latest())
    stages = {int(each.meta["env_steps"]): _parameters(each, part) for each in saved}
    return dict(sorted(stages.items()))  # a killed run may have a snapshot that is newer than its checkpoint


def _parameters(checkpoint: Checkpoint, player: str) -> Parameters:
    prefix = f"{player}/"
    return {name.removeprefix(prefix): array for name, array in checkpoint.arrays.items() if name.startswith(prefix)}
