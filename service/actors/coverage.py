"""Coverage: the share of the workspace that random skills reach, the paper's figure as a number.

A skill of primitives is one gate weight drawn at random and held for a whole episode (Peng et al. 2019; paper, section
5.1).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from service.base.progress import track
from service.base.types import FloatArray, StateArray
from service.config import WorkspaceConfig, WorldConfig
from service.config.run import CELL_SIZE_M
from service.envs.batch import WorldBatch
from service.envs.observations import ACTION, each_object
from service.policies.frozen_skills import FrozenSkills, SkillPlayer
from service.policies.numpy_policy import NumpyMCPPolicy

NUM_SKILLS = 32
"""Random skills of which coverage is measured, unless told otherwise (paper: 32)."""


class RandomPolicy:
    """One primitive that acts at random, as a baseline for coverage; composes as ``NumpyMCPPolicy`` does."""

    num_primitives = 1

    def compose(self, positions: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Zero mean and unit std."""
        shape = (positions.shape[0], ACTION.size)
        return np.zeros(shape, dtype=np.float32), np.ones(shape, dtype=np.float32)


def composition_paths(
    primitives: NumpyMCPPolicy | RandomPolicy,
    config: WorldConfig,
    *,
    num_skills: int,
    num_steps: int,
    seed: int,
    num_threads: int = 0,
) -> StateArray:
    """Object positions under random compositions.

    Weights are uniform in (0, 1]; actions are sampled from the composition.

    Returns:
        (K num_skills, num_steps + 1, 3) metres, each from a fresh reset.
    """
    rng = np.random.default_rng(seed)
    weights = (1.0 - rng.random((num_skills, primitives.num_primitives))).astype(np.float32)

    def act(positions: FloatArray) -> FloatArray:
        mean, std = primitives.compose(positions, weights)
        return mean + std * rng.standard_normal(mean.shape, dtype=np.float32)

    return object_paths(act, config, num_paths=num_skills, num_steps=num_steps, rng=rng, num_threads=num_threads)


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


def object_paths(
    act: Callable[[FloatArray], FloatArray],
    config: WorldConfig,
    *,
    num_paths: int,
    num_steps: int,
    rng: np.random.Generator,
    num_threads: int = 0,
    observe: Callable[[WorldBatch], None] = lambda worlds: None,
) -> StateArray:
    """Object positions while ``act``, (N, P) positions to (N, 4) actions, plays N worlds from fresh resets.

    ``observe`` is called at the start and after each step.

    Returns:
        (num_paths, num_steps + 1, 3) metres; of K objects K times as many, those of a world one after the other.
    """
    paths = np.empty((num_paths, num_steps + 1, 3 * config.num_objects))
    with WorldBatch(config, num_paths, num_threads=num_threads) as worlds:
        worlds.reset(rng)
        paths[:, 0] = worlds.object_position
        observe(worlds)
        for step in track(range(num_steps), "playing at random", num_steps, "steps"):
            worlds.step(act(worlds.positions()))
            paths[:, step + 1] = worlds.object_position
            observe(worlds)
    return each_object(paths).swapaxes(1, 2).reshape(-1, num_steps + 1, 3)


def visited_share(paths: StateArray, workspace: WorkspaceConfig) -> float:
    """Share of the workspace's table cells (seen from above) into which any of (M, T, 3) paths moved the object.

    The cell in which an object started does not count for its own path.
    """
    shape = np.array([round(workspace.length_x_m / CELL_SIZE_M), round(workspace.length_y_m / CELL_SIZE_M)])
    cells = np.floor((paths[:, :, :2] - workspace.lower_m[:2]) / CELL_SIZE_M).astype(np.int64)
    inside = ((cells >= 0) & (cells < shape)).all(axis=2)
    moved = (cells != cells[:, :1]).any(axis=2)
    visited = cells[inside & moved]
    return len(np.unique(visited, axis=0)) / int(shape.prod())
