"""Episodes of a task, played by any policy."""

from __future__ import annotations

from service.actors.evaluation import DeterministicPolicy, Evaluation, evaluate
from service.base.intervals import wilson_interval
from service.base.types import Metrics
from service.config import WorldConfig
from service.config.run import SUCCESS_DISTANCE_M
from service.envs.task import Task

CURVE_SEED, FINAL_SEED = 1_000_000, 2_000_000
"""Added to a run's seed: goals of evaluations are none that were learned on, and the same for every method."""


def evaluate_on(
    task: Task, world: WorldConfig, player: DeterministicPolicy, num_episodes: int, seed: int, num_threads: int = 0
) -> Evaluation:
    """Evaluate a player, who has not played yet, on a task.

    Args:
        task: is played.
        world: in which the player was trained, of which the task replaces its part.
        player: acts.
        num_episodes: random goals, each from a fresh reset.
        seed: of the episodes.
        num_threads: of physics; 0: as many as there are cores.
    """
    return evaluate(
        player,
        task.world_from(world),
        task,
        num_episodes=num_episodes,
        num_steps=task.episode_steps,
        success_distance_m=SUCCESS_DISTANCE_M,
        seed=seed,
        num_threads=num_threads,
    )


def numbers_of(found: Evaluation) -> Metrics:
    """The numbers of an evaluation as a run's result has them, with 95 % intervals."""
    low, high = wilson_interval(round(found.success_ever * found.num_episodes), found.num_episodes)
    measured = {**found.as_dict(), "success_ever_low": low, "success_ever_high": high}
    return {name: value for name, value in measured.items() if not isinstance(value, str)}
