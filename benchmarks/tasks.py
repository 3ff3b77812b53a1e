"""What a trained Bob is measured on: random goals that nobody proposed, also in worlds he was not trained in."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from service.actors.evaluation import Deterministic, Idle, evaluate
from service.config import Config, WorldConfig
from service.envs.goals import GoalKind

NUM_EPISODES, NUM_STEPS = 300, 50
ASKED, ASKED_STEPS = 0.90, 30e6
"""Of mixed goals, at the last step, after at most so many env steps from scratch."""
SEED = 0
"""Of the goals; those evaluated during a run are others."""


@dataclass(frozen=True, slots=True)
class Task:
    """Random goals in a world."""

    goals: GoalKind
    words: str
    asked: float
    """Success at the last step that we ask of Bob."""
    world: dict[str, Any] = field(default_factory=dict)
    """What of the run's own world is replaced."""


TASKS = {
    "mixed": Task("mixed", "anywhere in the workspace with probability 0.7, else on the table", 0.95),
    "air": Task("air", "more than 5 cm above an object that rests on the table", 0.95),
    "table": Task("table", "on the table", 0.95),
    "larger": Task(
        "mixed",
        "mixed goals in a workspace of 45 x 45 x 40 cm",
        0.90,
        {"workspace": {"length_x_m": 0.45, "length_y_m": 0.45, "height_m": 0.40}},
    ),
    "sphere": Task("mixed", "mixed goals for a sphere", 0.85, {"object": "sphere"}),
}


def task_world(task: Task, world: WorldConfig) -> WorldConfig:
    """The world of a task, for a Bob who was trained in ``world``."""
    tree = world.model_dump()
    for key, value in task.world.items():
        tree[key] = {**tree[key], **value} if isinstance(value, dict) else value
    return WorldConfig.model_validate(tree)


def measure_tasks(
    bob: Deterministic, config: Config, *, num_episodes: int = NUM_EPISODES, num_steps: int = NUM_STEPS
) -> list[dict[str, Any]]:
    """Bob without noise and a policy that does nothing, from fresh resets.

    Returns:
        Rows as ``tandem evaluate --json`` prints them; ``policy`` is "bob" or "idle", ``goals`` the task's name.
    """
    rows = []
    for name, task in TASKS.items():
        for label, policy in {"bob": bob, "idle": Idle()}.items():
            result = evaluate(
                policy,
                task_world(task, config.world),
                task.goals,
                num_episodes=num_episodes,
                num_steps=num_steps,
                success_distance_m=config.game.success_distance_m,
                seed=SEED,
                num_threads=config.run.num_threads,
            )
            rows.append({"policy": label, **result.as_dict(), "goals": name})
    return rows
