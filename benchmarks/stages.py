"""Coverage of random compositions of the primitives at three stages of training, beside a random policy.

The paper's figure shows 32 compositions at the beginning, in the middle and at the end. One such set visits few cells
of the table, so the share of visited cells is taken as the mean over several sets; the first is kept to be drawn.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from service.actors.coverage import NUM_SKILLS, Composable, RandomPolicy, skill_trajectories, visited_share
from service.config import Config
from service.media.artifacts import COVERAGE_STEPS
from service.policies.numpy_policy import NumpyMCPPolicy, numpy_bob
from service.policies.parameters import Parameters
from service.types import StateArray

NUM_SETS = 10
CELL_SIZE_M = 0.05
KEPT_EVERY = 4
"""Steps of a path; it is drawn, not measured."""
STAGES = {"beginning": 0.0, "middle": 0.5, "end": 1.0}
"""Shares of the run."""
RANDOM = "random policy"


def pick_stages(env_steps: Collection[int]) -> dict[str, int]:
    """Snapshots of Bob that show the stages of a run: those nearest to the stages' shares of its env steps.

    Args:
        env_steps: of training at each snapshot; where one is nearest to several stages, it shows the last of them.
    """
    steps = np.sort(list(env_steps))
    nearest = {int(steps[np.abs(steps - share * steps[-1]).argmin()]): name for name, share in STAGES.items()}
    return {name: at for at, name in nearest.items()}


def measure_coverage(
    bobs: Mapping[int, Parameters], config: Config, *, num_sets: int = NUM_SETS, num_steps: int = COVERAGE_STEPS
) -> dict[str, Any] | None:
    """The share of the workspace's table cells of 5 cm that each stage's compositions move the object into.

    Args:
        bobs: Bob's parameters by env steps of training.
        config: of the run.
        num_sets: sets of 32 compositions, each from a seed of its own, the same for all stages.
        num_steps: of each composition.

    Returns:
        For JSON; None for a monolithic Bob, who has nothing to compose.
    """
    evaluators = {name: (steps, numpy_bob(bobs[steps])) for name, steps in pick_stages(bobs).items()}
    stages: dict[str, dict[str, Any]] = {RANDOM: _measure(RandomPolicy(), config, num_sets, num_steps)}
    for name, (env_steps, bob) in evaluators.items():
        if not isinstance(bob, NumpyMCPPolicy):
            return None
        stages[name] = {"env_steps": env_steps, **_measure(bob, config, num_sets, num_steps)}
    return {"num_skills": NUM_SKILLS, "num_steps": num_steps, "cell_size_m": CELL_SIZE_M, "stages": stages}


def mean_share(stage: Mapping[str, Any]) -> float:
    """Mean share of the cells visited, over all sets of a stage."""
    return float(np.mean(stage["shares"]))


def paths_m(stage: Mapping[str, Any]) -> StateArray:
    """The kept paths of a stage, (number, points, 3) metres."""
    flat = np.array(stage["paths_mm"], dtype=np.float64) / 1000
    return flat.reshape(len(flat), -1, 3)


def _measure(primitives: Composable, config: Config, num_sets: int, num_steps: int) -> dict[str, Any]:
    sets = [
        skill_trajectories(
            primitives,
            config.world,
            num_skills=NUM_SKILLS,
            num_steps=num_steps,
            seed=seed,
            num_threads=config.run.num_threads,
        )
        for seed in range(num_sets)
    ]
    kept = np.round(1000 * sets[0][:, ::KEPT_EVERY]).astype(int)
    return {
        "shares": [round(visited_share(paths, config.world.workspace, cell_size_m=CELL_SIZE_M), 4) for paths in sets],
        "paths_mm": kept.reshape(NUM_SKILLS, -1).tolist(),
    }
