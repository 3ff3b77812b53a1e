"""Worlds that also show where everything was one step ago.

Positions alone do not say how fast the arm and the object move: the arm lags behind its commands, and what was pushed
slides on. A second set of positions does, and a real robot has it, too; no velocity is measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]
Info = dict[str, Any]
Observation = dict[str, Any]

PREVIOUS = "previous"
"""Name of what is added to an observation."""


@dataclass(frozen=True, slots=True)
class PreviousState:
    """Everything a :class:`PreviousPositionsVector` continues from."""

    worlds: Any
    """State of the environment inside."""
    previous: FloatArray
    """(N, 11) as last shown."""


class PreviousPositionsVector(gymnasium.vector.VectorWrapper[Any, FloatArray, Any, FloatArray, Any]):
    """Adds ``previous`` (11,), the positions one step ago, to what N environments show; at an episode's start, now's.

    Args:
        env: observes a mapping, with positions as ``observation``, and restarts episodes in the same step
            (``gymnasium.vector.AutoresetMode.SAME_STEP``).
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, FloatArray, Any]) -> None:
        super().__init__(env)
        assert isinstance(env.single_observation_space, gymnasium.spaces.Dict)
        spaces = dict(env.single_observation_space.spaces)
        self.single_observation_space = gymnasium.spaces.Dict({**spaces, PREVIOUS: spaces["observation"]})
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, env.num_envs)
        self._seen: FloatArray | None = None
        self._previous: FloatArray | None = None

    def reset(self, *, seed: Any = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Reset the environments."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._seen = self._previous = observation["observation"].copy()
        return self._with_previous(observation), info

    def step(self, actions: FloatArray) -> tuple[Observation, Any, Any, Any, Info]:
        """Act; also the last observations of episodes that end here have their previous positions."""
        if self._seen is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        observation, rewards, terminated, truncated, info = self.env.step(actions)
        before, now, done = self._seen, observation["observation"].copy(), terminated | truncated
        for world in np.flatnonzero(done):
            info["final_obs"][world][PREVIOUS] = before[world].copy()
        self._seen, self._previous = now, np.where(done[:, None], now, before)
        return self._with_previous(observation), rewards, terminated, truncated, info

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """The environments' own."""
        compute: Callable[..., Any] = getattr(self.env, "compute_reward")  # noqa: B009 - only goal environments have it
        return compute(achieved_goal, desired_goal, info)

    def state(self) -> PreviousState:
        """Copy everything that :meth:`restore` needs."""
        assert self._previous is not None, "reset comes first"
        return PreviousState(getattr(self.env, "state")(), self._previous.copy())  # noqa: B009

    def restore(self, state: PreviousState) -> Observation:
        """Go back to a saved state; continues bit-identically. The observation there."""
        observation: Observation = getattr(self.env, "restore")(state.worlds)  # noqa: B009
        self._seen, self._previous = observation["observation"].copy(), state.previous.copy()
        return self._with_previous(observation)

    def _with_previous(self, observation: Observation) -> Observation:
        assert self._previous is not None
        return {**observation, PREVIOUS: self._previous.copy()}
