"""Episodes of a task, played by any policy."""

from __future__ import annotations

from service.actors.evaluation import DeterministicPolicy, Evaluation, evaluate, wilson_interval
from service.base.types import Metrics
from service.config import WorldConfig
from service.envs.tasks import EPISODE_STEPS, SUCCESS_DISTANCE_M, find_task

CURVE_SEED, FINAL_SEED = 1_000_000, 2_000_000
"""Added to a run's seed: goals of evaluations are none that were learned on, and the same for every method."""


def evaluate_on(
    task: str, world: WorldConfig, player: DeterministicPolicy, num_episodes: int, seed: int, num_threads: int = 0
) -> Evaluation:
    """Evaluate a player, who has not played yet, on a task.

    Args:
        task: its name.
        world: in which the player was trained, of which the task replaces its part.
        player: acts.
        num_episodes: random goals, each from a fresh reset.
        seed: of the episodes.
        num_threads: of physics; 0: as many as there are cores.

    Raises:
        TandemError: no such task.
    """
    found = find_task(task)
    return evaluate(
        player,
        found.world_from(world),
        found.goals,
        num_episodes=num_episodes,
        num_steps=EPISODE_STEPS,
        success_distance_m=SUCCESS_DISTANCE_M,
        seed=seed,
        num_threads=num_threads,
    )


def numbers_of(found: Evaluation) -> Metrics:
    """The numbers of an evaluation as a run's result has them, with 95 % intervals."""
    low, high = wilson_interval(round(found.success_ever * found.num_episodes), found.num_episodes)
    measured = {**found.as_dict(), "success_ever_low": low, "success_ever_high": high}
    return {name: value for name, value in measured.items() if not isinstance(value, str)}
