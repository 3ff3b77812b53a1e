"""Policies for a robot: a published Bob, the Bob of a run, or an orchestrator of a downstream training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.actors.evaluation import DeterministicPolicy
from service.downstream.compose import check_robot
from service.downstream.methods import Method
from service.downstream.orchestrators import load_orchestrator, method_of
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
        reference: NAME@ALIAS of primitives or of an orchestrator, a run directory, or a directory of
            ``tandem downstream train``.
        registry: where they are looked up first.

    Raises:
        TandemError: nothing there, damaged, or a policy of another robot or layout.
    """
    method = method_of(reference, registry)
    found = _bob(reference, registry) if method is None else _orchestrator(reference, method, registry)
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


def _orchestrator(reference: str, method: Method, registry: Path) -> RobotPolicy:
    if method.takes is None:
        raise TandemError(f"{reference}: {method.title} acts without primitives; a bridge plays what composes them")
    found = load_orchestrator(reference, registry, registry)
    check_robot(found.trained)
    task = find_task(found.task)
    world = task.world_from(found.trained.config.world.nominal)
    return RobotPolicy(found.name, found.policy, world, task.goals, SUCCESS_DISTANCE_M)
