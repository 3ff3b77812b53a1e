"""Where random skills move the object."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from service.actors.coverage import object_paths
from service.base.types import StateArray
from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.policies.frozen_skills import FrozenSkills, SkillPlayer


def skill_paths(
    skills: FrozenSkills,
    config: WorldConfig,
    *,
    num_skills: int,
    num_steps: int,
    seed: int,
    num_threads: int = 0,
    observe: Callable[[WorldBatch], None] = lambda worlds: None,
) -> StateArray:
    """Object positions under random skills, without noise; see ``object_paths``.

    Returns:
        (num_skills, num_steps + 1, 3) metres, each from a fresh reset.
    """
    rng = np.random.default_rng(seed)
    player = SkillPlayer(skills, skills.draw(num_skills, rng))
    return object_paths(
        player,
        config,
        num_paths=num_skills,
        num_steps=num_steps,
        rng=rng,
        num_threads=num_threads,
        observe=observe,
    )
