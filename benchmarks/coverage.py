"""Coverage of random skills, compositions of primitives or skill vectors, at three stages of training.

Beside them a random policy. The paper's figure shows 32 skills at the beginning, in the middle and at the end. One such
set visits few cells of the table, so the share of visited cells is taken as the mean over several sets; the first is
kept to be drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any

import numpy as np

from benchmarks.run_files import CELL_SIZE_M, RANDOM, STAGES
from service.actors.coverage import NUM_SKILLS, RandomPolicy, skill_paths, skill_trajectories, visited_share
from service.base.types import StateArray
from service.config import Config
from service.config.skills import SkillDiscoveryConfig
from service.media.artifacts import COVERAGE_STEPS
from service.policies.frozen_skills import FrozenSkills
from service.policies.numpy_policy import NumpyMCPPolicy, numpy_bob
from service.policies.parameters import Parameters

NUM_SETS = 10
KEPT_EVERY = 4
"""Steps of a path; it is drawn, not measured."""
_Player = Callable[..., StateArray]
"""Plays the random skills of a ``seed``; their paths."""


def pick_stages(env_steps: Collection[int]) -> dict[str, int]:
    """Snapshots nearest to the stages' shares of a run; one that is nearest to several shows the last of them."""
    steps = np.sort(list(env_steps))
    nearest = {int(steps[np.abs(steps - share * steps[-1]).argmin()]): name for name, share in STAGES.items()}
    return {name: at for at, name in nearest.items()}


def measure_coverage(
    stages: Mapping[int, Parameters], config: Config, *, num_sets: int = NUM_SETS, num_steps: int = COVERAGE_STEPS
) -> dict[str, Any] | None:
    """The share of the workspace's table cells of 5 cm that each stage's random skills move the object into.

    Args:
        stages: parameters of Bob, or of skills, by env steps of training.
        config: of the run.
        num_sets: sets of 32 skills, each from a seed of its own, the same for all stages.
        num_steps: of each skill.

    Returns:
        For JSON; None for a monolithic Bob, who has nothing to compose.
    """
    common: dict[str, Any] = {"num_skills": NUM_SKILLS, "num_steps": num_steps, "num_threads": config.run.num_threads}

    def player(parameters: Parameters) -> _Player | None:
        if isinstance(config, SkillDiscoveryConfig):
            return partial(skill_paths, FrozenSkills(parameters, config.skills.method), config.world, **common)
        bob = numpy_bob(parameters)
        return partial(skill_trajectories, bob, config.world, **common) if isinstance(bob, NumpyMCPPolicy) else None

    found: dict[str, dict[str, Any]] = {
        RANDOM: _measure(partial(skill_trajectories, RandomPolicy(), config.world, **common), config, num_sets)
    }
    for name, env_steps in pick_stages(stages).items():
        if (play := player(stages[env_steps])) is None:
            return None
        found[name] = {"env_steps": env_steps, **_measure(play, config, num_sets)}
    return {"num_skills": NUM_SKILLS, "num_steps": num_steps, "cell_size_m": CELL_SIZE_M, "stages": found}


def _measure(play: _Player, config: Config, num_sets: int) -> dict[str, Any]:
    sets = [play(seed=seed) for seed in range(num_sets)]
    kept = np.round(1000 * sets[0][:, ::KEPT_EVERY]).astype(int)
    return {
        "shares": [round(visited_share(paths, config.world.workspace, cell_size_m=CELL_SIZE_M), 4) for paths in sets],
        "paths_mm": kept.reshape(NUM_SKILLS, -1).tolist(),
    }
