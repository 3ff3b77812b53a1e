"""The worlds that a downstream learner acts in: they keep the positions of the step before, and count success."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import gymnasium
import numpy as np

from service.downstream.inputs import learner_inputs
from service.envs.gym.vector import VectorState
from service.envs.observations import POSITIONS
from service.sac.replay import Columns
from service.types import Array, Arrays, BoolArray, FloatArray

COLUMNS = {"previous": POSITIONS.size, "positions": POSITIONS.size, "following": POSITIONS.size, "goal": 3, "reward": 1}
"""Columns of a transition, beside ``action``: positions one step ago, now and after it, goal and reward."""


class TaskWorlds:
    """A ``TabletopVectorEnv``, bare or composed, for ``sac.loop.OffPolicyLoop``.

    Args:
        env: restarts episodes in the same step (``gymnasium.vector.AutoresetMode.SAME_STEP``).
        seed: episodes begin here; world i draws its own from ``seed + i``.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any], seed: int) -> None:
        self.env: Any = env
        self.finished: list[tuple[float, bool]] = []
        """Return and success at the last step of the episodes that ended since this list was last cleared."""
        self._returns = np.zeros(env.num_envs)
        observation, _ = env.reset(seed=seed)
        self._positions, self._goal = observation["observation"].copy(), observation["desired_goal"].copy()
        self._previous = self._positions.copy()

    @property
    def num_worlds(self) -> int:
        """N."""
        return int(self.env.num_envs)

    @property
    def num_actions(self) -> int:
        """Size of a learner's action: weights of composed primitives, or the robot's own."""
        return int(self.env.single_action_space.shape[0])

    def inputs(self) -> FloatArray:
        """(N, 23) what the actor sees now."""
        return learner_inputs(self._previous, self._positions, self._goal)

    def step(self, actions: FloatArray) -> tuple[Columns, BoolArray]:
        """Act by (N, A) actions.

        Returns:
            The transitions, ``COLUMNS`` and ``action``, and (N,) whose episodes ended.
        """
        observation, rewards, terminated, truncated, info = self.env.step(actions)
        ended = terminated | truncated
        following = observation["observation"].copy()
        self._returns += rewards
        for world in np.flatnonzero(ended):
            following[world] = info["final_obs"][world]["observation"]
            self.finished.append((float(self._returns[world]), bool(info["final_info"]["is_success"][world])))
        self._returns[ended] = 0.0
        columns = {
            "previous": self._previous,
            "positions": self._positions,
            "following": following,
            "goal": self._goal,
            "reward": rewards[:, None],
            "action": actions,
        }
        now = observation["observation"].copy()
        self._previous = np.where(ended[:, None], now, self._positions)
        self._positions, self._goal = now, observation["desired_goal"].copy()
        return columns, ended

    def rewards(self, following: FloatArray, goal: FloatArray) -> FloatArray:
        """(B,) rewards for (B, 11) positions come to, had the goals (B, 3) been others."""
        paid: FloatArray = self.env.compute_reward(following[:, POSITIONS["object"]], goal, {})
        return paid

    def state(self) -> tuple[Arrays, Any]:
        """Copy everything that ``load_state`` needs: ``VectorState``, previous positions and returns."""
        worlds = asdict(self.env.state())
        random = worlds.pop("random")
        return {**worlds, "previous": self._previous.copy(), "returns": self._returns.copy()}, random

    def load_state(self, arrays: Mapping[str, Array], random: Any) -> None:
        """Go back to a saved state; continues bit-identically."""
        worlds: dict[str, Any] = {name: np.array(array) for name, array in arrays.items()}
        self._previous, self._returns = worlds.pop("previous"), worlds.pop("returns")
        observation = self.env.restore(VectorState(**worlds, random=tuple(random)))
        self._positions, self._goal = observation["observation"].copy(), observation["desired_goal"].copy()

    def close(self) -> None:
        """Stop the worlds' threads."""
        self.env.close()
