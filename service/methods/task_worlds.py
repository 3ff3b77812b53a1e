"""The worlds of a task, in which a downstream learner acts: by its own actions, by weights of primitives, or by skills.

They count its success.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from service.base.types import Array, Arrays, BoolArray, FloatArray
from service.envs.observations import PAPER, Layouts
from service.envs.task import num_in_rows
from service.learner.off_policy import Step, TabletopWorlds
from service.learner.replay import Columns
from service.policies.frozen_skills import FrozenSkills
from service.policies.learned_policy import learner_inputs

_POSITIONS = ("previous", "positions", "following")


def columns(seen: Layouts, *, view: bool = False) -> dict[str, int]:
    """Sizes of a transition's columns, by name, but for ``action``.

    They are positions one env step ago, now and when it ended, goal and reward; with ``view`` also what the functions
    of a task saw when it ended.
    """
    num = seen.num_objects
    kept = {**dict.fromkeys(_POSITIONS, seen.positions.size), "goal": 3 * num, "reward": 1}
    return {**kept, "view": num_in_rows(num)} if view else kept


class TaskWorlds(TabletopWorlds):
    """See ``TabletopWorlds``; where the environment is composed, actions are weights of its primitives."""

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any], seed: int, seen: Layouts = PAPER) -> None:
        super().__init__(env, seed)
        self.seen = seen
        """Layouts of the worlds."""
        self.finished: list[tuple[float, bool]] = []
        """Return and success at the last step of the episodes that ended since this list was last cleared."""
        self._returns = np.zeros(self.num_worlds)

    def inputs(self) -> FloatArray:
        """(N, I) what the actor sees now."""
        return learner_inputs(self.previous, self.positions, self.goal, self.seen)

    def step(self, actions: FloatArray) -> tuple[Columns, BoolArray]:
        """Act by (N, A) actions.

        Returns:
            The transitions, ``columns`` and ``action``, and (N,) whose episodes ended.
        """
        step = self.advance(actions)
        self._returns += step.reward
        self.finished += zip(self._returns[step.ended].tolist(), step.success[step.ended].tolist(), strict=True)
        self._returns[step.ended] = 0.0
        columns = {name: getattr(step, name) for name in (*_POSITIONS, "goal")}
        if step.view is not None:
            columns["view"] = step.view
        return {**columns, "reward": step.reward[:, None], "action": actions}, step.ended

    def rewards(self, rows: Columns, goal: FloatArray) -> FloatArray:
        """(B,) rewards of transitions, (B, size) a column, had their goals (B, 3 K) been others."""
        if "view" in rows:
            paid: FloatArray = self.env.unwrapped.rewards_of(rows["view"], goal)
            return paid
        paid = self.env.compute_reward(rows["following"][:, self.seen.positions["object"]], goal, {})
        return paid

    def state(self) -> tuple[Arrays, Any]:
        """Copy everything that ``load_state`` needs."""
        arrays, random = super().state()
        return {**arrays, "returns": self._returns.copy()}, random

    def load_state(self, arrays: dict[str, Array], random: Any) -> None:
        """Go back to a saved state; continues bit-identically."""
        worlds = dict(arrays)
        self._returns = np.array(worlds.pop("returns"))
        super().load_state(worlds, random)


class SkillTaskWorlds(TaskWorlds):
    """A task's worlds in which the frozen policy acts by the skill that the learner sets.

    Args:
        env: see ``TaskWorlds``.
        seed: of episodes.
        skills: act; never changed.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any], seed: int, skills: FrozenSkills) -> None:
        self._skills = skills
        super().__init__(env, seed)

    @property
    def num_actions(self) -> int:
        """Size of a skill vector."""
        return int(self._skills.size)

    def advance(self, actions: FloatArray) -> Step:
        """Act by the skills of (N, Z) actions."""
        skill = self._skills.from_action(actions)
        return super().advance(self._skills.actions(self.previous, self.positions, skill))
