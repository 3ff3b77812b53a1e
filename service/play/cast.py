"""Who plays in a live world: Bob or an orchestrator, Alice where a run has her, and the world they play in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from service.actors.evaluation import DeterministicPolicy
from service.actors.self_play import StochasticPolicy
from service.config import Config, WorldConfig
from service.downstream.orchestrators import Orchestrator
from service.downstream.skills import ZeroShotPolicy
from service.envs.gym.registration import EPISODE_STEPS
from service.envs.sampling import GoalKind
from service.envs.tasks import SUCCESS_DISTANCE_M, find_task
from service.io.run_directory import RunDirectory
from service.policies.numpy_policy import NumpyMCPPolicy
from service.primitives.loading import TrainedBob, TrainedSkills, load_either, load_players


@dataclass(frozen=True, slots=True)
class Cast:
    """The players of a live world."""

    label: str
    """Who plays, such as ``panda-cube@3``."""
    world: WorldConfig
    bob: DeterministicPolicy
    """Goes to goals: Bob, an orchestrator, or the skill that leads there."""
    goals: GoalKind
    """Of random goals."""
    success_distance_m: float
    bob_steps: int
    """Of a goal, after which another one comes."""
    hold_steps: int
    """At the goal, after which it counts as solved."""
    primitives: NumpyMCPPolicy | None = None
    """What sliders drive."""
    alice: StochasticPolicy | None = None
    alice_steps: int = 0
    num_goals: int = 1
    """Rounds of a game."""


def cast_primitives(reference: str, registry: Path, task: str | None = None) -> Cast:
    """The cast of published primitives or skills, or of a run, which has Alice as well.

    Args:
        reference: NAME, NAME@ALIAS or NAME@VERSION, or a run directory.
        registry: directory to look in first.
        task: of a downstream task, in whose world to play; Alice is not in it.

    Raises:
        TandemError: nothing there by that reference, no such task, or skills that no goal leads.
    """
    trained = load_either(reference, registry)
    config = trained.config
    alice: StochasticPolicy | None = None
    if isinstance(trained, TrainedSkills):
        bob: DeterministicPolicy = ZeroShotPolicy(trained.skills)
        return _cast(trained.label, config, bob, task)
    if trained.manifest is None and task is None and config.is_self_play and config.game.alice_plays:
        alice, _ = load_players(RunDirectory(Path(reference)))
    primitives = trained.policy if isinstance(trained.policy, NumpyMCPPolicy) else None
    return _cast(trained.label, config, trained.policy, task, primitives, alice)


def cast_orchestrator(orchestrator: Orchestrator, task: str | None = None) -> Cast:
    """The cast of an orchestrator on its task, or on another.

    Raises:
        TandemError: no such task.
    """
    trained = orchestrator.trained
    policy = trained.policy if isinstance(trained, TrainedBob) else None
    primitives = policy if isinstance(policy, NumpyMCPPolicy) else None
    return _cast(orchestrator.label, trained.config, orchestrator, task or orchestrator.task, primitives)


def _cast(
    label: str,
    config: Config,
    bob: DeterministicPolicy,
    task: str | None,
    primitives: NumpyMCPPolicy | None = None,
    alice: StochasticPolicy | None = None,
) -> Cast:
    game = config.game
    if task is not None:
        found = find_task(task)
        world = found.world_from(config.world)
        return Cast(
            f"{label} on {found.title}", world, bob, found.goals, SUCCESS_DISTANCE_M, EPISODE_STEPS,
            EPISODE_STEPS // 4, primitives,
        )  # fmt: skip
    goals: GoalKind = "mixed" if config.world.fixture == "none" else "table"
    return Cast(
        label, config.world, bob, goals, game.success_distance_m, game.bob_steps, max(game.bob_hold_steps, 1),
        primitives, alice, game.alice_steps, game.num_goals,
    )  # fmt: skip
