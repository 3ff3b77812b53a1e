"""What a trained Bob is measured on: random goals that nobody proposed, also in worlds he was not trained in."""

from __future__ import annotations

from typing import Any

from service.actors.evaluation import Deterministic, Idle, evaluate
from service.config import Config
from service.envs.tasks import TASKS as DOWNSTREAM
from service.envs.tasks import Task

NUM_EPISODES, NUM_STEPS = 300, 50
ASKED = 0.90
"""Of mixed goals, at the last step."""
SEED = 0
"""Of the goals; those evaluated during a run are others."""


TASKS = {
    "mixed": Task("Mixed", "anywhere in the workspace with probability 0.7, else on the table", "mixed", 0.7),
    "air": Task("Air", "more than 5 cm above an object that rests on the table", "air", 1.0),
    "table": Task("Table", "on the table", "table", 0.0),
    "larger": DOWNSTREAM["larger"],
    "sphere": DOWNSTREAM["sphere"],
}


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
                task.world_from(config.world),
                task.goals,
                num_episodes=num_episodes,
                num_steps=num_steps,
                success_distance_m=config.game.success_distance_m,
                seed=SEED,
                num_threads=config.run.num_threads,
            )
            rows.append({"policy": label, **result.as_dict(), "goals": name})
    return rows
