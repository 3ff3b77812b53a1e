"""Many worlds as one Gymnasium vector environment, stepped together, for learners that want many samples."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from service.base.errors import TandemError
from service.base.types import BoolArray, FloatArray
from service.config import WorldConfig
from service.envs.gym.tabletop import GoalWorlds, Observation, action_space, goal_space
from service.envs.task import Task

Info = dict[str, Any]


class TabletopVectorEnv(GoalWorlds, gymnasium.vector.VectorEnv[Any, FloatArray, NDArray[Any]]):
    """N environments like ``TabletopEnv``, whose worlds are stepped in native threads.

    World i of a reset with seed s plays the very episodes, bit for bit, of a ``TabletopEnv`` that was reset with seed
    s + i, under a time limit. An episode that ends starts anew within the same step
    (``gymnasium.vector.AutoresetMode.SAME_STEP``): the observation is the first of the next episode, and
    ``info["final_obs"]`` and ``info["final_info"]`` hold the last of the old one, laid out as by
    ``gymnasium.vector.SyncVectorEnv``. All other ``info`` is as that class has it, too, but for ``info["view"]``: where
    success or reward are the task's own functions, ``View.rows`` of what they saw.

    Args:
        num_envs: N.
        config: the world; the paper's by default.
        task: see ``TabletopEnv``.
        success_distance_m: greatest distance that counts as reached, metres.
        registered: the task of its Gymnasium name; ``gymnasium.make_vec`` gives this itself.
        max_episode_steps: where episodes are truncated; None: where the task says; -1: nowhere.
        num_threads: native threads; 0 for one per core.
        render_mode: None, as there are no pictures of many worlds.

    Raises:
        TandemError: unknown ``task``, goals that the world cannot have, a distance that is not positive, or a
            ``render_mode``.
        ValueError: ``num_envs`` below 1, or ``max_episode_steps`` below 1 and not -1.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 - as the base class has it

    def __init__(
        self,
        num_envs: int = 1,
        config: WorldConfig | None = None,
        *,
        task: Path | str | Task | None = None,
        success_distance_m: float = 0.05,
        registered: str | None = None,
        max_episode_steps: int | None = None,
        num_threads: int = 0,
        render_mode: None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs = {num_envs}; give at least 1")
        if max_episode_steps is not None and max_episode_steps < 1 and max_episode_steps != -1:
            raise ValueError(f"max_episode_steps = {max_episode_steps}; give at least 1, or -1 for no end")
        if render_mode is not None:
            raise TandemError(
                f"TabletopVectorEnv: render_mode = {render_mode!r}; for pictures give gymnasium.make_vec "
                'vectorization_mode="sync"'
            )
        super().__init__(num_envs, num_threads, config, task, success_distance_m, registered)
        self.num_envs = num_envs
        self.max_episode_steps = self.rules.task.episode_steps if max_episode_steps is None else max_episode_steps
        self.single_observation_space, self.single_action_space = goal_space(self.config), action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Start an episode in every world.

        Args:
            seed: world i draws its episodes from ``seed + i``, or ``seed[i]``; None goes on with the random numbers.
            options: ``{"goal": ...}``, (3 K,) one for all worlds or (N, 3 K), metres, in place of the random goals of
                these episodes; those that begin on their own have random ones again.

        Raises:
            ValueError: not one seed per world.
            TandemError: an unknown option, a goal of another shape, not finite or out of reach.
        """
        goal = self._given(options)
        seeds = [seed + world for world in range(self.num_envs)] if isinstance(seed, int) else seed
        if seeds is not None:
            if len(seeds) != self.num_envs:
                raise ValueError(f"seed: expected {self.num_envs} of them, one per world, got {len(seeds)}")
            for world, each in enumerate(seeds):
                if each is not None:
                    self._random[world] = seeding.np_random(each)[0]
        self._start(np.ones(self.num_envs, dtype=bool), goal)
        observation, view = self._observe()
        return observation, _with_masks({"is_success": self.rules.success(view)})

    def step(self, actions: FloatArray) -> tuple[Observation, NDArray[Any], BoolArray, BoolArray, Info]:
        """Act for one control step of 40 ms in every world; see the class for what happens where an episode ends.

        Args:
            actions: (N, 4) in [-1, 1], as of ``TabletopEnv``.

        Raises:
            ValueError: actions of the wrong shape.
            DivergedError: actions that are not finite.
        """
        diverged = self._advance(actions)
        observation, view = self._observe()
        success, reward = self.rules.success(view), self.rules.reward(view)
        is_over = self.rules.elapsed >= self.max_episode_steps
        truncated = diverged | (is_over & (self.max_episode_steps != -1))
        info: Info = _with_masks({"view": view.rows()}) if self.rules.task.is_own else {}
        if truncated.any():
            info |= _with_masks({"final_obs": _rows(observation, truncated)}, truncated)
            last = {"is_success": success & truncated, "diverged": diverged}
            info |= _with_masks({"final_info": _with_masks(last, truncated)}, truncated)
            self._start(truncated)
            observation, view = self._observe()
            success = self.rules.success(view)
        info |= _with_masks({"is_success": success})
        if not truncated.all():
            info |= _with_masks({"diverged": diverged & ~truncated}, ~truncated)
        return observation, reward, np.zeros_like(truncated), truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the native threads."""
        self._worlds.close()


def _with_masks(values: Info, mask: BoolArray | None = None) -> Info:
    """Vector info as Gymnasium has it: beside every ``key``, ``_key`` says for which worlds it holds; None: all."""
    masks = {
        f"_{key}": np.ones(len(value), dtype=bool) if mask is None else mask.copy() for key, value in values.items()
    }
    return {**values, **masks}


def _rows(observation: Observation, worlds: BoolArray) -> NDArray[np.object_]:
    """(N,) each world's own observation, None where ``worlds`` is false."""
    rows = np.full(len(worlds), None, dtype=object)
    for world in np.flatnonzero(worlds):
        rows[world] = {name: value[world] for name, value in observation.items()}
    return rows
