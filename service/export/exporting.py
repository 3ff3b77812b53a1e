"""Exports a policy into a folder that needs nothing of Tandem; the folder appears when everything in it is tried."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from service.actors.evaluation import DeterministicPolicy
from service.config import WorldConfig
from service.downstream.methods import Method
from service.downstream.orchestrators import load_orchestrator, method_of
from service.downstream.policy import LearnedPolicy
from service.envs.gym.registration import EPISODE_STEPS
from service.envs.observations import layouts
from service.envs.sampling import GoalKind
from service.envs.tasks import SUCCESS_DISTANCE_M, find_task
from service.export.describing import describe
from service.export.description import FILE, Description
from service.export.errors import ExportError
from service.export.formats import find_format
from service.export.measurements import Episodes, measure
from service.export.networks import Network, network_of_orchestrator, networks_of_bob, networks_of_primitives
from service.export.parity import check_parity, make_inputs
from service.export.readme import make_readme
from service.io.files import new_directory, os_errors
from service.io.tensors import digest_of
from service.primitives.loading import TrainedBob, load_bob

Part = Literal["all", "policy", "primitives"]
PARTS: tuple[Part, ...] = ("all", "policy", "primitives")
"""What of a policy is exported: all that there is, the policy without its primitives one by one, or only those."""


@dataclass(frozen=True, slots=True)
class Source:
    """A policy to export."""

    name: str
    networks: tuple[Network, ...]
    world: WorldConfig
    goals: GoalKind
    task: str | None
    num_steps: int
    success_distance_m: float
    players: Callable[[], DeterministicPolicy]
    """Makes the evaluator's policy, ready for a batch of episodes."""
    digests: Mapping[str, str]

    def episodes(self, num: int) -> Episodes:
        """Episodes of it, to measure."""
        return Episodes(self.world, self.goals, num, self.num_steps, self.success_distance_m, self.players)


def find_source(reference: str, registry: Path, part: Part, primitives: str | None = None) -> Source:
    """Find what to export.

    Args:
        reference: of a published Bob or orchestrator; or the directory of a run, or of a downstream training.
        registry: that versions are in.
        part: one of ``PARTS``.
        primitives: that an orchestrator composes, where they are not where its training found them.

    Raises:
        TandemError: nothing there by that reference, skills, damaged, or without the part that was asked for.
    """
    if part not in PARTS:
        raise ExportError(f"unknown part {part!r}; choose one of {', '.join(PARTS)}")
    if (method := method_of(reference, registry)) is not None:
        return _orchestrator(reference, method, registry, part, primitives)
    if primitives is not None:
        raise ExportError(f"{reference} is no orchestrator: primitives are named for one only")
    trained = load_bob(reference, registry)
    networks = networks_of_bob(trained) if part != "primitives" else []
    if part == "primitives" or (part == "all" and networks[0].function == "bob"):
        networks += networks_of_primitives(trained)
    config = trained.config
    return Source(
        name=_name(trained),
        networks=tuple(networks),
        world=config.world.nominal,
        goals="mixed",
        task=None,
        num_steps=config.run.evaluation_steps,
        success_distance_m=config.game.success_distance_m,
        players=partial(_same, trained),
        digests={"policy": digest_of("", trained.parameters)},
    )


def export(source: Source, format_name: str, folder: Path, *, num_episodes: int = 100) -> Description:
    """Write a policy into a new folder, try what was written, and describe it.

    Args:
        source: the policy.
        format_name: ``onnx``, ``numpy`` or ``torchscript``.
        folder: that is made.
        num_episodes: played to measure, for each delay.

    Raises:
        ExportError: no such format, or packages for it are missing.
        ParityError: what was written does not compute what the evaluator's policy does; nothing is left.
        StorageError: the folder is there already, or cannot be written.
    """
    chosen = find_format(format_name)
    with new_directory(folder) as temporary:
        measured, observations = measure(source.episodes(num_episodes))
        inputs = make_inputs(observations, layouts(source.world))
        with os_errors("write", temporary):
            chosen.shared(temporary)
        networks = {}
        for network in source.networks:
            path = temporary / f"{network.name}{chosen.ending}"
            with os_errors("write", path):
                chosen.write(network, path)
            networks[path.name] = network, check_parity(network, chosen.read(network, path), inputs)
        description = describe(
            source.name,
            source.world,
            networks,
            measured,
            format_name=format_name,
            task=source.task,
            success_distance_m=source.success_distance_m,
            digests=source.digests,
        )
        with os_errors("write", temporary):
            (temporary / FILE).write_text(description.model_dump_json(indent=1) + "\n", encoding="utf-8")
            (temporary / "README.md").write_text(make_readme(description), encoding="utf-8")
    return description


def _orchestrator(reference: str, method: Method, registry: Path, part: Part, primitives: str | None) -> Source:
    if not method.composes:
        raise ExportError(f"{reference} was trained with a method that composes no primitives: export one of ours")
    found = load_orchestrator(reference, registry, registry, primitives)
    trained, player = found.trained, found.policy
    assert isinstance(trained, TrainedBob)
    assert isinstance(player, LearnedPolicy)
    networks = [network_of_orchestrator(trained, found.method, player.parameters)] if part != "primitives" else []
    if part != "policy":
        networks += networks_of_primitives(trained)
    task = find_task(found.task)
    return Source(
        name=f"{found.name} with {_name(trained)}",
        networks=tuple(networks),
        world=task.world_from(trained.config.world.nominal),
        goals=task.goals,
        task=found.task,
        num_steps=EPISODE_STEPS,
        success_distance_m=SUCCESS_DISTANCE_M,
        players=partial(LearnedPolicy, player.parameters, method, trained),
        digests={"orchestrator": digest_of("", player.parameters), "primitives": digest_of("", trained.parameters)},
    )


def _name(trained: TrainedBob) -> str:
    """What it is called elsewhere, where paths of this machine mean nothing."""
    if trained.manifest is not None:
        return trained.manifest.reference
    return f"{trained.config.name} of the run {Path(trained.label).resolve().name}"


def _same(trained: TrainedBob) -> DeterministicPolicy:
    return trained.policy
