"""Policies for a robot: a published Bob, the Bob of a run, or an orchestrator of a downstream training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.actors.evaluation import DeterministicPolicy
from service.downstream.compose import check_robot
from service.downstream.directory import read_trial
from service.downstream.files import made_with, read_json
from service.downstream.methods import find_method, load_for
from service.downstream.policy import load_policy
from service.envs.observations import ACTION, layouts
from service.envs.sampling import GoalKind
from service.envs.tasks import SUCCESS_DISTANCE_M, find_task
from service.errors import TandemError
from service.primitives.loading import load_bob
from service.world_config import WorldConfig


@dataclass(frozen=True, slots=True)
class RobotPolicy:
    """A frozen policy, and what it was trained for."""

    label: str
    policy: DeterministicPolicy
    world: WorldConfig
    """The nominal one, where it was trained in worlds that are drawn."""
    goals: GoalKind
    """That it is tried on."""
    success_distance_m: float


def load_robot_policy(reference: str, registry: Path) -> RobotPolicy:
    """Load what ``--policy`` names.

    Args:
        reference: NAME@ALIAS, a run directory, or a directory of ``tandem downstream train``.
        registry: where primitives are looked up first.

    Raises:
        TandemError: nothing there, damaged, or a policy of another robot or layout.
    """
    directory = Path(reference)
    found = _orchestrator(directory, registry) if (directory / "cell.json").is_file() else _bob(reference, registry)
    if found.world.num_observed_obstacles:
        raise TandemError(f"{found.label} observes obstacles, and the bridge measures the object alone; train without")
    size = layouts(found.world).bob.size
    try:
        shape = found.policy.act_deterministic(np.zeros((1, size), dtype=np.float32)).shape
    except ValueError as error:
        raise TandemError(f"{found.label} does not take {size} numbers, as the bridge measures them: {error}") from None
    if shape != (1, ACTION.size):
        raise TandemError(f"{found.label} acts by {shape[-1]} numbers; the bridge takes {ACTION.size}")
    return found


def _bob(reference: str, registry: Path) -> RobotPolicy:
    trained = load_bob(reference, registry)
    check_robot(trained)
    config = trained.config
    return RobotPolicy(trained.label, trained.policy, config.world.nominal, "mixed", config.game.success_distance_m)


def _orchestrator(directory: Path, registry: Path) -> RobotPolicy:
    tree = read_json(directory / "cell.json")
    trial = read_trial(tree, directory / "cell.json")
    primitives = made_with(tree)["primitives"]
    if find_method(trial.method).takes is None or primitives is None:
        raise TandemError(f"{directory}: {trial.method} acts without primitives; a bridge plays what composes them")
    trained = load_for([trial.method], primitives["name"], registry)
    check_robot(trained)
    task = find_task(trial.task)
    policy = load_policy(directory / "policy.safetensors", trained)
    world = task.world_from(trained.config.world.nominal)
    return RobotPolicy(trial.name, policy, world, task.goals, SUCCESS_DISTANCE_M)
