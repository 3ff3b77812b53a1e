"""Evaluation of a trained Bob: random goals that nobody proposed, also in worlds he was not trained in."""

from __future__ import annotations

from typing import Any

from service.actors.evaluation import DeterministicPolicy, IdlePolicy, evaluate
from service.config import Config
from service.envs.tasks import TASKS as DOWNSTREAM
from service.envs.tasks import Task

NUM_EPISODES, NUM_STEPS = 300, 50
ASKED, ASKED_STEPS = 0.90, 30e6
"""Success on mixed goals at the last step, after at most so many env steps from scratch."""
SEED = 0
"""Seed of the goals; those evaluated during a run are others."""

TASKS = {
    "mixed": Task("Mixed", "anywhere in the workspace with probability 0.7, else on the table", "mixed"),
    "air": Task("Air", "more than 5 cm above an object that rests on the table", "air"),
    "table": Task("Table", "on the table", "table"),
    "larger": DOWNSTREAM["larger"],
    "sphere": DOWNSTREAM["sphere"],
}
ASKED_RATES = {"mixed": 0.95, "air": 0.95, "table": 0.95, "larger": 0.90, "sphere": 0.85}
"""Success at the last step that we ask of Bob."""


def measure_tasks(
    bob: DeterministicPolicy, config: Config, *, num_episodes: int = NUM_EPISODES, num_steps: int = NUM_STEPS
) -> list[dict[str, Any]]:
    """Bob without noise and a policy that does nothing, from fresh resets.

    Returns:
        Rows as ``tandem evaluate --json`` prints them; ``policy`` is "bob" or "idle", ``goals`` the task's name.
    """
    rows = []
    for name, task in TASKS.items():
        for label, policy in {"bob": bob, "idle": IdlePolicy()}.items():
            result = evaluate(
                policy,
                task.world_from(config.world),
                task.goals,
                num_episodes=num_episodes,
                num_steps=num_steps,
                success_distance_m=config.success_distance_m,
                seed=SEED,
                num_threads=config.run.num_threads,
            )
            rows.append({"policy": label, **result.as_dict(), "goals": name})
    return rows
