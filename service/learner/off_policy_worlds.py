"""Tabletop worlds for the off-policy loop: they keep the positions of the step before."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from service.base.types import Array, Arrays, BoolArray, FloatArray
from service.envs.gym.tabletop import EnvState


class Step(NamedTuple):
    """A step of N worlds."""

    previous: FloatArray
    """(N, 11) positions one step before ``positions``."""
    positions: FloatArray
    """(N, 11) that were acted on."""
    before: FloatArray
    """(N, 11) one env step before ``following``: those that were acted on, where an action lasts for one."""
    following: FloatArray
    """(N, 11) that the actions led to."""
    goal: FloatArray
    """(N, 3) metres."""
    reward: FloatArray
    """(N,) of the worlds' task."""
    ended: BoolArray
    """(N,) it was the last of its episode."""
    success: BoolArray
    """(N,) the goal was reached, where ``ended``."""


class TabletopWorlds:
    """A ``TabletopVectorEnv``, bare or wrapped, and what it showed last.

    Args:
        env: restarts episodes in the same step (``gymnasium.vector.AutoresetMode.SAME_STEP``).
        seed: episodes begin here; world i draws its own from ``seed + i``.
    """

    steps_per_action = 1
    """Env steps that an action lasts."""

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any], seed: int) -> None:
        self.env: Any = env
        self._see(env.reset(seed=seed)[0])
        self.previous = self.positions
        """(N, 11) positions one step ago; at an episode's start those of now."""

    @property
    def num_worlds(self) -> int:
        """N."""
        return int(self.env.num_envs)

    @property
    def num_actions(self) -> int:
        """Size of a learner's action."""
        return int(self.env.single_action_space.shape[0])

    def advance(self, actions: FloatArray) -> Step:
        """Act by (N, A) actions; a world whose episode ends begins the next at once."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        ended = terminated | truncated
        following, success = observation["observation"].copy(), np.zeros_like(ended)
        for world in np.flatnonzero(ended):
            following[world] = info["final_obs"][world]["observation"]
            success[world] = info["final_info"]["is_success"][world]
        step = Step(
            self.previous,
            self.positions,
            self.positions,
            following,
            self.goal,
            reward.astype(np.float32),
            ended,
            success,
        )
        self._see(observation)
        self.previous = np.where(ended[:, None], self.positions, step.positions)
        return step

    def state(self) -> tuple[Arrays, Any]:
        """Copy everything that ``load_state`` needs: arrays by name, and random numbers as plain values."""
        worlds = asdict(self.env.state())
        random = worlds.pop("random")
        return {**worlds, "previous": self.previous.copy()}, random

    def load_state(self, arrays: dict[str, Array], random: Any) -> None:
        """Go back to a saved state; continues bit-identically."""
        worlds: dict[str, Any] = {name: np.array(array) for name, array in arrays.items()}
        self.previous = worlds.pop("previous")
        self._see(self.env.restore(EnvState(**worlds, random=tuple(random))))

    def close(self) -> None:
        """Stop the worlds' threads."""
        self.env.close()

    def _see(self, observation: dict[str, FloatArray]) -> None:
        self.positions: FloatArray = observation["observation"].copy()
        """(N, 11) now."""
        self.goal: FloatArray = observation["desired_goal"].copy()
        """(N, 3) metres."""
