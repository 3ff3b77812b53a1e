"""The off-policy loop on tabletop worlds.

Every world makes a step, the transitions are kept, and the learner makes several updates.

Consumes worlds and a way to make batches; produces a learned actor. It waits for nothing: what is asked of ``play`` is
done when it returns.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np

from service.base.tensors import join_parts, split_parts
from service.base.types import Array, Arrays, BoolArray, FloatArray, Metrics
from service.envs.gym.tabletop import EnvState
from service.learner.replay import Columns, ReplayBuffer

if TYPE_CHECKING:  # lists of methods are read where torch is not needed
    from service.learner.sac import Batch, SACLearner


class Step(NamedTuple):
    """A step of N worlds."""

    previous: FloatArray
    """(N, P) positions one step before ``positions``."""
    positions: FloatArray
    """(N, P) that were acted on."""
    following: FloatArray
    """(N, P) that the actions led to."""
    goal: FloatArray
    """(N, 3 K) metres."""
    reward: FloatArray
    """(N,) of the worlds' task."""
    ended: BoolArray
    """(N,) it was the last of its episode."""
    success: BoolArray
    """(N,) the task was solved, where ``ended``."""
    view: FloatArray | None
    """(N, V) ``View.rows`` that the actions led to, where success or reward are the task's own functions."""


class TabletopWorlds(ABC):
    """N worlds that step together, a ``TabletopVectorEnv``, bare or wrapped, and what it showed last.

    A world whose episode ends begins the next within the same step.

    Args:
        env: restarts episodes in the same step (``gymnasium.vector.AutoresetMode.SAME_STEP``).
        seed: episodes begin here; world i draws its own from ``seed + i``.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any], seed: int) -> None:
        self.env: Any = env
        self._see(env.reset(seed=seed)[0])
        self.previous = self.positions
        """(N, P) positions one step ago; at an episode's start those of now."""

    @abstractmethod
    def inputs(self) -> FloatArray:
        """(N, I) what the actor sees now."""

    @abstractmethod
    def step(self, actions: FloatArray) -> tuple[Columns, BoolArray]:
        """Act by (N, A) actions; the transitions, as a replay buffer keeps them, and (N,) whose episodes ended."""

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
            following,
            self.goal,
            reward.astype(np.float32),
            ended,
            success,
            info.get("view"),
        )
        self._see(observation)
        self.previous = np.where(ended[:, None], self.positions, step.positions)
        return step

    def state(self) -> tuple[Arrays, Any]:
        """Copy everything that ``load_state`` needs: arrays by name, and random numbers as plain values."""
        worlds = asdict(self.env.state())
        random = worlds.pop("random")
        if not worlds["memory"].size:
            del worlds["memory"]  # most tasks keep none
        return {**worlds, "previous": self.previous.copy()}, random

    def load_state(self, arrays: dict[str, Array], random: Any) -> None:
        """Go back to a saved state; continues bit-identically."""
        worlds: dict[str, Any] = {name: np.array(array) for name, array in arrays.items()}
        self.previous = worlds.pop("previous")
        worlds.setdefault("memory", np.zeros((self.num_worlds, 0)))
        self._see(self.env.restore(EnvState(**worlds, random=random)))

    def close(self) -> None:
        """Stop the worlds' threads."""
        self.env.close()

    def _see(self, observation: dict[str, FloatArray]) -> None:
        self.positions: FloatArray = observation["observation"].copy()
        """(N, P) now."""
        self.goal: FloatArray = observation["desired_goal"].copy()
        """(N, 3 K) metres."""


BatchMaker = Callable[[ReplayBuffer, int, np.random.Generator], "Batch"]
"""Makes a batch of so many transitions from a replay buffer: draws them, and says what is seen and what is paid."""


class OffPolicyLoop:
    """Worlds, a replay buffer and a learner.

    Args:
        worlds: have begun.
        replay: has the columns that the worlds' steps give.
        learner: its settings say how often and from how much it learns, and how long actions are uniform first.
        make_batch: see ``BatchMaker``.
        seed: of uniform actions, of what is drawn from the buffer and of what ``make_batch`` draws.
    """

    def __init__(
        self, worlds: TabletopWorlds, replay: ReplayBuffer, learner: SACLearner, make_batch: BatchMaker, seed: int
    ) -> None:
        self.worlds, self.replay, self.learner, self.make_batch = worlds, replay, learner, make_batch
        self.num_updates = 0
        self._rng = np.random.default_rng(seed)

    @property
    def num_env_steps(self) -> int:
        """Env steps made so far, those of uniform actions among them."""
        return self.replay.num_added * self.replay.num_worlds

    def play(self, num_env_steps: int) -> Metrics:
        """Make at least so many env steps, with their updates, and average the actor.

        Returns:
            Means over the updates; none before learning begins.
        """
        from service.learner.sac import wide_products

        config, found = self.learner.config, list[Metrics]()
        until = self.num_env_steps + num_env_steps
        with wide_products():
            while self.num_env_steps < until:
                inputs = self.worlds.inputs()
                if self.num_env_steps < config.learning_starts:
                    actions = actions_at_random((len(inputs), self.learner.num_actions), self._rng)
                else:
                    actions = self.learner.act(inputs)
                self.replay.add(*self.worlds.step(actions))
                if self.num_env_steps > config.learning_starts:
                    size = config.gradient_steps * config.batch_size
                    found.append(self.learner.update(self.make_batch(self.replay, size, self._rng)))
                    self.num_updates += config.gradient_steps
        if found:
            self.learner.average_actor()
        return {name: float(np.mean([each[name] for each in found])) for name in (found[0] if found else ())}

    def state(self) -> tuple[Arrays, dict[str, Any]]:
        """Everything a new loop of the same settings continues from: arrays by name, and plain values."""
        worlds, random = self.worlds.state()
        arrays = join_parts({"learner": self.learner.state(), "replay": self.replay.state(), "worlds": worlds})
        return arrays, {"worlds": random, "loop": self._rng.bit_generator.state, "num_updates": self.num_updates}

    def load_state(self, arrays: Mapping[str, Array], values: Mapping[str, Any]) -> None:
        """Continue, bit for bit, where ``state`` gave these."""
        parts = split_parts(arrays)
        self.learner.load_state(parts["learner"])
        self.replay.load_state(parts["replay"])
        self.worlds.load_state(parts["worlds"], values["worlds"])
        self._rng.bit_generator.state = values["loop"]
        self.num_updates = values["num_updates"]


def actions_at_random(shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
    """Uniform actions in [-1, 1], float32: what a new learner begins with."""
    return rng.uniform(-1.0, 1.0, shape).astype(np.float32)
