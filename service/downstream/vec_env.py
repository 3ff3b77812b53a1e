"""Worlds as a Stable-Baselines3 ``VecEnv``: many native environments behind the interface that its learners know."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from service.envs.gym.vector import VectorState
from service.types import FloatArray

Observation = dict[str, FloatArray]
Info = dict[str, Any]

PREVIOUS = "previous"
"""Name of what is added to an observation: the positions one step ago."""


class WorldsVecEnv(VecEnv):
    """A ``TabletopVectorEnv``, bare or composed, for Stable-Baselines3.

    Seeds, observations, rewards, dones and infos are those of a ``DummyVecEnv`` of single environments under a time
    limit, with monitors: at an episode's end ``terminal_observation``, ``TimeLimit.truncated`` and ``episode`` (its
    return r and length l). As there, a world starts anew within the step that ends its episode.

    An observation has one entry more, ``previous`` (11,): the positions one step ago, at an episode's start those of
    now. Positions alone do not say how fast the arm and the object move: the arm lags behind its commands, and what was
    pushed slides on. A second set does, and a real robot has it, too; no velocity is measured.

    Args:
        env: restarts episodes in the same step (``gymnasium.vector.AutoresetMode.SAME_STEP``), and observes a mapping
            with the positions as ``observation``.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any]) -> None:
        self.env: Any = env
        self.finished: list[tuple[float, bool]] = []
        """Return and success at the last step of the episodes that ended since this list was last cleared."""
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, dtype=np.int64)
        assert isinstance(env.single_observation_space, gymnasium.spaces.Dict)
        spaces = dict(env.single_observation_space.spaces)
        space = gymnasium.spaces.Dict({**spaces, PREVIOUS: spaces["observation"]})
        super().__init__(env.num_envs, space, env.single_action_space)

    def reset(self) -> Any:
        """Start an episode in every world, from the seeds given by ``seed``."""
        seeds: Any = None if all(seed is None for seed in self._seeds) else self._seeds
        observation, _ = self.env.reset(seed=seeds)
        self._returns[:], self._lengths[:] = 0.0, 0
        self._reset_seeds()
        self._reset_options()
        return self._show(observation, observation["observation"])

    def step_async(self, actions: FloatArray) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Step every world.

        Returns:
            Observations, float32 rewards, dones and infos, (N, ...) each.
        """
        observation, rewards, terminated, truncated, info = self.env.step(self._actions)
        before, done = self._now, terminated | truncated
        self._returns += rewards
        self._lengths += 1
        infos: list[Info] = [{"TimeLimit.truncated": False} for _ in range(self.num_envs)]
        for world, success in enumerate(info["is_success"]):
            infos[world]["is_success"] = bool(success)
        for world in np.flatnonzero(done).tolist():
            info["final_obs"][world][PREVIOUS] = before[world].copy()
            infos[world] = self._last_info(world, info, only_time=bool(truncated[world] and not terminated[world]))
        shown = self._show(observation, np.where(done[:, None], observation["observation"], before))
        return shown, rewards.astype(np.float32), done, infos

    def _show(self, observation: Observation, previous: FloatArray) -> Observation:
        """The observation with the previous positions, of which copies are kept."""
        self._now, self._previous = observation["observation"].copy(), previous.copy()
        return {**observation, PREVIOUS: previous.copy()}

    def _last_info(self, world: int, info: Info, *, only_time: bool) -> Info:
        """The info of a world whose episode has ended; its sums begin again."""
        success = bool(info["final_info"]["is_success"][world])
        total, length = float(self._returns[world]), int(self._lengths[world])
        self.finished.append((total, success))
        self._returns[world], self._lengths[world] = 0.0, 0
        return {
            "TimeLimit.truncated": only_time,
            "terminal_observation": info["final_obs"][world],
            "is_success": success,
            "episode": {"r": total, "l": length},
        }

    def state(self) -> dict[str, Any]:
        """Copy everything that :meth:`restore` needs.

        Returns:
            The entries of ``VectorState``, (N, 11) ``previous`` positions as last shown, and of the episodes that go on
            (N,) ``returns`` and (N,) ``lengths``.
        """
        worlds = asdict(self.env.state())
        returns, lengths = self._returns.copy(), self._lengths.copy()
        return {**worlds, "previous": self._previous.copy(), "returns": returns, "lengths": lengths}

    def restore(self, state: dict[str, Any]) -> Observation:
        """Go back to a saved state; continues bit-identically.

        Returns:
            The observation there.
        """
        worlds = dict(state)
        previous = worlds.pop("previous")
        self._returns, self._lengths = worlds.pop("returns").copy(), worlds.pop("lengths").copy()
        return self._show(self.env.restore(VectorState(**worlds)), previous)

    def close(self) -> None:
        """Stop the worlds' threads."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The environments' common attribute, once per world asked for."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: the worlds share everything.

        Raises:
            AttributeError: always.
        """
        raise AttributeError(f"the worlds of one batch share {attr_name}; make the environment with it")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """The common method's answer, once per world asked for; hindsight relabelling asks for ``compute_reward``."""
        answer = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [answer for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Any = None) -> Any:
        """False for each: wrappers of single environments have no place here."""
        return [False for _ in self._get_indices(indices)]
