"""The one way to load what was trained: ``load`` gives a ``Trained`` for every kind of reference.

A reference names a version of a registry, a run, a checkpoint of a run, a downstream training, or an exported version.
Acting is NumPy: nothing here needs torch.
"""

from __future__ import annotations

import copy
import functools
import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from service.base.errors import ConfigError, TandemError
from service.base.parsing import NAME
from service.base.tensors import digest_of, split_parts
from service.base.types import FloatArray
from service.base.user_code import changed_since, parse_reference
from service.config import Config, WorldConfig
from service.config.run import SUCCESS_DISTANCE_M
from service.config.skills import SkillDiscoveryConfig
from service.config.task import TaskConfig
from service.envs.observations import layouts
from service.envs.task import Task
from service.envs.tasks import find_task
from service.policies.frozen_skills import FrozenSkills, ZeroShotPolicy
from service.policies.learned_policy import LearnedPolicy
from service.policies.numpy_actor import numpy_actor
from service.policies.numpy_policy import NumpyGaussianPolicy, NumpyMCPPolicy, NumpyPolicy, numpy_bob
from service.policies.parameters import Parameters, PolicyError
from service.registry.bundled import BUNDLED, find_version, is_bundled, is_exported
from service.registry.digest import parameters_digest
from service.registry.manifest import Manifest, acting_config
from service.store.checkpoints import Checkpoint, CheckpointStore, read_checkpoint
from service.store.run_directory import Published, RunDirectory

if TYPE_CHECKING:
    from service.actors.evaluation import DeterministicPolicy
    from service.envs.sampling import GoalKind

Kind = Literal["primitives", "skills", "orchestrator"]
"""Bob, who has primitives unless he is monolithic; skills of a baseline; or a policy of a downstream task.

Spaces in a manifest have it as ``kind``; without it they are of primitives.
"""
_SHOWN = 12
"""Characters of a digest in messages."""
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Trained:
    """A trained policy, primitives or skills, ready to act, with configuration and manifest.

    Policies of tasks and skills keep the step before: call ``begin`` before new episodes.
    """

    label: str
    """Where it comes from, such as ``panda-cube@3 (bundled)``."""
    kind: Kind
    config: Config
    """Of the run; of a policy of a task, that of what it acts with."""
    policy: DeterministicPolicy
    """Goes to goals: Bob, the skill that leads there, or what was learned for a task."""
    parameters: Parameters = field(compare=False, repr=False)
    """That the policy was made of."""
    manifest: Manifest | None = None
    """Of a version; None of a directory of a run or training."""
    path: Path | None = None
    """The directory or file it was read from; None for a version in a registry."""
    networks: Mapping[str, Parameters] = field(default_factory=dict, compare=False, repr=False)
    """What another run can begin from, by ``bob/policy``, ``bob/value``, ``alice/policy`` and ``alice/value``; of a
    version, and of distillation, only the first."""
    alice: NumpyGaussianPolicy | None = None
    """Of a run of self-play."""
    task: Task | None = None
    """The task that it plays."""
    method: str | None = None
    """Name of the method that learned a policy of a task, such as ``ours-her``."""
    acts_with: Trained | None = None
    """The primitives or skills that a policy of a task acts with, if any."""

    @property
    def name(self) -> str:
        """Name without a path of this machine, for manifests and model cards."""
        if self.manifest is not None:
            return self.manifest.reference
        if self.kind == "orchestrator" or self.path is None:
            return self.config.directory_name
        place = self.path.resolve()
        if place.is_file():  # a checkpoint or a snapshot
            return f"{self.config.name} of the run {place.parent.parent.name}, {place.stem}"
        return f"{self.config.name} of the run {place.name}"

    @property
    def title(self) -> str:
        """Its label, and the task that it plays."""
        return self.label if self.task is None else f"{self.label} on {self.task.title}"

    @property
    def reference(self) -> str:
        """A reference that finds the same again from any directory: without an alias, or an absolute path."""
        if self.path is not None:
            return str(self.path.absolute())
        return self.label if self.manifest is None else self.manifest.reference

    @property
    def published(self) -> Published | None:
        """The version and its digest; None of a run or training."""
        return None if self.manifest is None else Published(self.manifest.reference, self.manifest.blob_sha256)

    @property
    def world(self) -> WorldConfig:
        """The world of its task, or of its training."""
        return self.config.world if self.task is None else self.task.world_from(self.config.world)

    @property
    def nominal(self) -> Trained:
        """The same in the world without ``world.randomisation``."""
        config, task = self.config.model_copy(update={"world": self.config.world.nominal}), self.task
        if task is not None:
            task = replace(task, world={key: value for key, value in task.world.items() if key != "randomisation"})
        return replace(self, config=config, task=task)

    @property
    def tried_on(self) -> Task:
        """The task that it is evaluated on: its own, or random goals."""
        return self.task or Task("Goals", goals=self.config.world.usual_goals)

    @property
    def goal_kind(self) -> GoalKind:
        """Kind of the random goals that it is evaluated on, where success is to be within a distance of them.

        Raises:
            TandemError: its task has starts, goals, success or reward of its own.
        """
        task = self.tried_on
        if task.closed or task.is_own or task.starts or not isinstance(task.goals, str):
            raise TandemError(
                f"{self.title}: that task has starts, goals, success or reward of its own, which are not known here"
            )
        return task.goals

    def on_goals(self, kind: GoalKind | None) -> Task:
        """The task that it is evaluated on, with random goals of that kind; None: with its own."""
        return self.tried_on if kind is None else replace(self.tried_on, goals=kind)

    @property
    def num_steps(self) -> int:
        """Steps of an episode in which it is tried."""
        return self.config.run.evaluation_steps if self.task is None else self.task.episode_steps

    @property
    def success_distance_m(self) -> float:
        """Greatest distance from object to goal that counts as success."""
        return self.config.success_distance_m if self.task is None else SUCCESS_DISTANCE_M

    @property
    def primitives(self) -> NumpyMCPPolicy:
        """The primitives, which can be composed; of a policy of a task, those that it acts with.

        Raises:
            TandemError: it has none.
        """
        if self.acts_with is not None:
            return self.acts_with.primitives
        if not isinstance(self.policy, NumpyMCPPolicy):
            why = "trained with policy.monolithic_bob" if self.kind == "primitives" else self._what
            raise TandemError(f"{self.label} has no primitives: it is {why}; load some, such as panda-cube@champion")
        return self.policy

    @property
    def skills(self) -> FrozenSkills:
        """The skills, which act by a vector z; of a policy of a task, those that it acts with.

        Raises:
            TandemError: it has none.
        """
        if self.acts_with is not None:
            return self.acts_with.skills
        if not isinstance(self.policy, ZeroShotPolicy):
            raise TandemError(
                f"{self.label} has no skills: it is {self._what}; load what a method of skill discovery learned"
            )
        return self.policy.skills

    @property
    def digest(self) -> str:
        """SHA-256 of the parameters; of primitives and skills as ``parameters_digest`` has it."""
        policy = self.skills if self.kind == "skills" else self.policy
        if isinstance(policy, NumpyPolicy | FrozenSkills):
            return parameters_digest(policy)
        return digest_of(self.acts_with.digest if self.acts_with is not None else "", self.parameters)

    def begin(self) -> None:
        """Forget the last step: new episodes begin."""
        begin = getattr(self.policy, "begin", None)
        if begin is not None:
            begin()

    def act_deterministic(self, observation: FloatArray | Mapping[str, FloatArray]) -> FloatArray:
        """Compute (N, 4) actions in [-1, 1] from (N, O) positions and goal, such as (N, 14), metres.

        Or (4,) from (O,); or from what a Gymnasium environment of Tandem shows, which has both.

        Raises:
            PolicyError: another shape; of a policy of a task another N than in the step before, without ``begin``.
        """
        if isinstance(observation, Mapping):
            if missing := {"observation", "desired_goal"} - observation.keys():
                raise PolicyError(
                    f"observation: no {' and no '.join(sorted(missing))}; give positions and goal, (N, O)"
                )
            observation = np.concatenate([observation["observation"], observation["desired_goal"]], axis=-1)
        if observation.ndim == 1:
            return np.squeeze(self.act_deterministic(observation[None]), axis=0)
        return np.clip(self.policy.act_deterministic(observation), -1.0, 1.0)

    def player(self) -> DeterministicPolicy:
        """A copy of the policy, at the start of new episodes: those that this one plays go on."""
        played = replace(self, policy=copy.copy(self.policy))
        played.begin()
        return played.policy

    def on(self, task: str | None) -> Trained:
        """Return a copy that plays a task, by its name or file, without Alice; None: itself.

        Raises:
            TandemError: no such task, or one of more or fewer objects.
        """
        return self if task is None else self.playing(find_task(task))

    def playing(self, task: Task) -> Trained:
        """Return a copy that plays a task, without Alice.

        Raises:
            TandemError: the task has more or fewer objects, or lets policies see something else.
        """
        world, known = task.world_from(self.config.world), self.config.world
        if (num := world.num_objects) != known.num_objects:
            of = f"a world of {known.num_objects} object{'s' * (known.num_objects > 1)}"
            raise TandemError(
                f"{self.label} was trained in {of}, and {task.title} has {num}: name what was trained in such a world"
            )
        if (there := layouts(world).positions.size) != (seen := layouts(known).positions.size):
            raise TandemError(
                f"{self.label} sees {seen} positions, and in the world of {task.title} there are {there}: leave "
                "world.observed as it is"
            )
        return replace(self, task=task, alice=None)

    def expect(self, *kinds: Kind, by: str) -> Trained:
        """Return itself, if it is of one of these kinds.

        Args:
            kinds: that will do.
            by: what needs them, such as ``tandem coverage``.

        Raises:
            TandemError: it is of another kind.
        """
        if self.kind in kinds:
            return self
        wanted = " or ".join("a policy of a task" if kind == "orchestrator" else kind for kind in kinds)
        hint = (
            f": name {self.acts_with.name}, which it acts with"
            if self.acts_with and self.acts_with.kind in kinds
            else ""
        )
        raise TandemError(f"{self.label} is {self._what}; {by} needs {wanted}{hint}")

    def expect_goals(self, by: str) -> Trained:
        """Return itself, if it can be sent to goals.

        Raises:
            TandemError: it cannot; see ``expect``.
        """
        if self.kind == "skills" and self.skills.zero_shot == "none":
            raise TandemError(f"{self.label} is {self._what}, which no goal leads; {by} needs a policy with goals")
        return self

    @property
    def _what(self) -> str:
        if self.kind == "skills":
            return f"a set of skills of {self.skills.method}"
        if self.kind == "primitives" or self.task is None:
            return "a set of primitives"
        return f"a policy of the task {self.task.name}"


def load(
    reference: Path | str,
    registry: Path | str = "registry",
    primitives: str | None = None,
    *,
    run_task_code: bool = False,
) -> Trained:
    """Load what was trained; see ``service.load``."""
    path, reference = Path(reference), str(reference)
    if re.search(r"\.py(:|$)", reference) and not path.is_dir():
        raise TandemError(f"{reference} is code, and what was trained is asked for; name a task by --task {reference}")
    is_place = path.is_dir() or "/" in reference or (path.suffix == ".safetensors" and path.is_file())
    if is_exported(path) or not is_place:
        found = _load_version(reference, registry, primitives, run_task_code=run_task_code)
    elif (path / "policy.json").exists():
        raise TandemError(
            f"{reference} is a folder of tandem export, made for use without tandem: name what it was made of, as its "
            "README.md says"
        )
    elif path.is_dir():
        found = _load_run(reference, RunDirectory(path), None, (registry, primitives))
    elif path.is_file():
        found = _load_run(reference, RunDirectory(path.absolute().parent.parent), path, (registry, primitives))
    else:
        raise TandemError(
            f"{reference}: no such directory of a run, training or exported version; for published versions write "
            "NAME@ALIAS"
        )
    if primitives is not None and found.acts_with is None:
        raise TandemError(f"{found.label} acts with nothing else: leave out primitives {primitives!r}")
    return found


def _task_of(spaces: Mapping[str, Any], manifest: Manifest, label: str, *, run_code: bool) -> Task:
    """The task of a published policy: a user's own without its functions, unless its code may run.

    Raises:
        TandemError: no such task, or a manifest that lacks what its own one needs.
    """
    name, code = str(spaces["task"]), cast("Any", manifest.config.get("code"))
    reference = parse_reference(name)
    if reference is None:
        return find_task(name)
    if run_code:
        if not isinstance(code, dict) or not isinstance(code.get(reference.origin), str):
            raise TandemError(f"{label}: its manifest lacks the text of {reference.origin}; publish it again")
        return find_task(name, code, cast("Any", manifest.config.get("task_world")))
    why = (
        f"{label}: what counts is said by code of its publisher, {name}; read it in the manifest, then give "
        "--run-task-code"
    )
    try:
        return Task(**{**dict(spaces["own_task"]), "closed": why})
    except (KeyError, TypeError, ValueError) as error:
        raise TandemError(f"{label}: its manifest does not describe its task, {name}: {error}") from None


def _load_version(reference: str, registry: Path | str, primitives: str | None, *, run_task_code: bool) -> Trained:
    place, version = find_version(reference, registry)
    manifest, parameters = place.load(str(version))
    # two registries may both have a version 1: which one was meant must be seen
    label = f"{version} (bundled)" if is_bundled(place) else str(version)
    path = Path(reference) if is_exported(Path(reference)) else None
    kind = manifest.spaces.get("kind", "primitives")
    if kind == "orchestrator":
        spaces: dict[str, Any] = dict(manifest.spaces)
        try:
            name, digest, hold_steps = spaces["primitives"], spaces["primitives_digest"], spaces["hold_steps"]
            if re.fullmatch(f"{NAME}@[0-9]+", str(name)) is None:  # a directory could bring code
                raise TandemError(f"{label}: it acts with {name!r}, which is no NAME@VERSION; publish it again")
            about: dict[str, Any] = {
                "task": _task_of(spaces, manifest, label, run_code=run_task_code),
                "method": spaces["method"],
            }
        except KeyError as error:
            raise TandemError(f"{label}: its manifest lacks {error}; publish it again") from None
        acts_with = _find_frozen(label, name, digest, (registry, primitives))
        policy = learned_policy(parameters, acts_with, acts_with.config, hold_steps)
        return Trained(
            label, "orchestrator", acts_with.config, policy, parameters, manifest, path, acts_with=acts_with, **about
        )
    config = acting_config(manifest.config, where=f"the manifest of {reference}")
    try:
        if isinstance(config, SkillDiscoveryConfig):
            return Trained(label, "skills", config, _skills(config, parameters), parameters, manifest, path)
        if kind == "primitives":
            bob, networks = NumpyMCPPolicy(parameters), {"bob/policy": parameters}
            return Trained(label, "primitives", config, bob, parameters, manifest, path, networks)
    except PolicyError as error:
        raise TandemError(f"{label} holds no {kind}: {error}") from None
    raise TandemError(f"{label} is of the kind {kind!r}, which this tandem cannot load; load it with a newer one")


def network_problems(manifest: Manifest, arrays: Parameters) -> list[str]:
    """Tell what keeps a policy from being made of a version's parameters, in one line; empty when it can be made.

    A manifest without networks in its configuration describes none, and nothing is asked of it.
    """
    try:
        if manifest.spaces.get("kind") == "orchestrator":
            numpy_actor(dict(arrays))
        elif manifest.config.keys() & {"policy", "skills"}:
            config = acting_config(manifest.config, where="its configuration")
            if isinstance(config, SkillDiscoveryConfig):
                _skills(config, arrays)
            else:
                NumpyMCPPolicy(arrays)
    except TandemError as error:
        return [str(error)]
    return []


def _skills(config: SkillDiscoveryConfig, parameters: Parameters) -> ZeroShotPolicy:
    return ZeroShotPolicy(FrozenSkills(parameters, config.skills))


@functools.cache
def _warn_once(text: str, *about: str) -> None:
    _logger.warning(text, *about)


def _load_run(label: str, directory: RunDirectory, file: Path | None, place: tuple[Path | str, str | None]) -> Trained:
    """What a run has learned: in a checkpoint or snapshot of it, or in the newest checkpoint."""
    if file is not None and not directory.exists:
        raise ConfigError(f"{label} is a file, and no checkpoint of a run: name a run, or a version as NAME@ALIAS")
    config = directory.read_config()
    saved: Checkpoint = CheckpointStore(directory.checkpoints).load_latest() if file is None else read_checkpoint(file)
    parts, path = split_parts(saved.arrays), file or directory.path
    if config.makes is None or config.part not in parts:
        raise TandemError(f"{label} is a run of the method {config.method}, which makes nothing that can be loaded")
    for origin in changed_since(config.code):
        _warn_once("%s has another text by now; %s keeps the one that it began with", origin, label)
    parameters = parts[config.part]
    if isinstance(config, SkillDiscoveryConfig):
        return Trained(label, "skills", config, _skills(config, parameters), parameters, path=path)
    if isinstance(config, TaskConfig):
        acts_with = None
        if config.primitives_digest is not None:
            acts_with = _find_frozen(label, config.primitives, config.primitives_digest, place)
        policy = learned_policy(parameters, acts_with, config)
        task = find_task(config.task, config.code, config.task_world)
        about: dict[str, Any] = {"task": task, "method": config.method, "acts_with": acts_with}
        return Trained(label, "orchestrator", config, policy, parameters, path=path, **about)
    networks: dict[str, Parameters] = {"bob/policy": parameters}
    alice = None
    if "learner" in parts and "alice" in parts:
        learner = {player: split_parts(own) for player, own in split_parts(parts["learner"]).items()}
        networks = {
            f"{player}/{part}": learner[player][part] for player in ("bob", "alice") for part in ("policy", "value")
        }
        alice = NumpyGaussianPolicy(parts["alice"])
    return Trained(
        label, "primitives", config, numpy_bob(parameters), parameters, path=path, networks=networks, alice=alice
    )


def learned_policy(
    parameters: Parameters, acts_with: Trained | None, config: Config, hold_steps: int = 1
) -> LearnedPolicy:
    """A policy of a task, of its actor's parameters, and of what it acts with, learned in the world of ``config``."""
    frozen = None if acts_with is None else acts_with.skills if acts_with.kind == "skills" else acts_with.primitives
    return LearnedPolicy(parameters, frozen, layouts(config.world), hold_steps)


def _find_frozen(label: str, name: str, digest: str, place: tuple[Path | str, str | None]) -> Trained:
    """The primitives or skills of that digest: where they are said to be, in the registry, or what is bundled.

    A version is looked up as such: a directory of that name might have code of its own.
    """
    registry, named = place
    places: list[tuple[str, Path | str]] = [(named, registry)] if named else [(name, registry), (name, BUNDLED)]
    problems = []
    for reference, root in places:
        try:
            is_place = reference == named or "/" in reference
            found = load(reference, root) if is_place else _load_version(reference, root, None, run_task_code=False)
            trained = found.expect("primitives", "skills", by=label)
        except TandemError as error:
            problems.append(str(error))
            continue
        if trained.digest == digest:
            return trained
        problems.append(f"{trained.label} has other parameters, digest {trained.digest[:_SHOWN]}")
    raise TandemError(
        f"{label} acts with {name} of digest {digest[:_SHOWN]}, which is not here: {problems[0]}; "
        "name it with --primitives, or the registry that has it with --registry"
    )
