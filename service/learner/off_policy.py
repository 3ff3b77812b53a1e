"""The off-policy loop: every world makes a step, the transitions are kept, and the learner makes several updates.

Consumes worlds and a way to make batches; produces a learned actor. It waits for nothing: what is asked of ``play`` is
done when it returns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from service.base.tensors import join_parts, split_parts
from service.base.types import Array, Arrays, BoolArray, FloatArray, Metrics
from service.learner.replay import Columns, ReplayBuffer
from service.learner.sac import Batch, SACLearner, actions_at_random


class Worlds(Protocol):
    """N worlds that step together; one whose episode ends begins the next within the same step."""

    steps_per_action: int
    """Env steps that an action lasts."""

    def inputs(self) -> FloatArray:
        """(N, I) what the actor sees now."""

    def step(self, actions: FloatArray) -> tuple[Columns, BoolArray]:
        """Act by (N, A) actions; the transitions, as a replay buffer keeps them, and (N,) whose episodes ended."""

    def state(self) -> tuple[Arrays, Any]:
        """Everything that ``load_state`` continues from: arrays by name, and random numbers as plain values."""

    def load_state(self, arrays: dict[str, Array], random: Any) -> None:
        """Go back to a saved state; continues bit for bit."""


BatchMaker = Callable[[ReplayBuffer, int, np.random.Generator], Batch]
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
        self, worlds: Worlds, replay: ReplayBuffer, learner: SACLearner, make_batch: BatchMaker, seed: int
    ) -> None:
        self.worlds, self.replay, self.learner, self.make_batch = worlds, replay, learner, make_batch
        self.num_updates = 0
        self._rng = np.random.default_rng(seed)

    @property
    def num_env_steps(self) -> int:
        """Env steps made so far, those of uniform actions among them."""
        return self.replay.num_added * self.replay.num_worlds * self.worlds.steps_per_action

    def play(self, num_env_steps: int, on_steps: Callable[[int], None] = lambda num: None) -> Metrics:
        """Make at least so many env steps, with their updates, and average the actor.

        Args:
            num_env_steps: to be made.
            on_steps: called with the number of env steps whenever some were made.

        Returns:
            Means over the updates; none before learning begins.
        """
        config, found = self.learner.config, list[Metrics]()
        until = self.num_env_steps + num_env_steps
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
            on_steps(self.replay.num_worlds * self.worlds.steps_per_action)
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
