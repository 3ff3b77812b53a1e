"""Frozen skills downstream: a learner's action is a skill vector that is held for some steps."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from service.base.types import FloatArray
from service.learner.off_policy import Step
from service.methods.task_worlds import TaskWorlds
from service.policies.frozen_skills import FrozenSkills


class SkillTaskWorlds(TaskWorlds):
    """A task's worlds in which the frozen policy acts by the skill that the learner sets.

    Args:
        env: see ``TaskWorlds``.
        seed: of episodes.
        skills: act; never changed.
        hold_steps: env steps that a skill is held. Where it does not divide an episode, the last one is shorter.
    """

    def __init__(
        self, env: gymnasium.vector.VectorEnv[Any, Any, Any], seed: int, skills: FrozenSkills, hold_steps: int
    ) -> None:
        self._skills, self.steps_per_action = skills, hold_steps
        super().__init__(env, seed)

    @property
    def num_actions(self) -> int:
        """Size of a skill vector."""
        return int(self._skills.size)

    def advance(self, actions: FloatArray) -> Step:
        """Hold the skills of (N, Z) actions; rewards are summed.

        A world whose episode ends on the way plays on in its next one, by the same skill: the learner sees that one
        from where it then is.
        """
        skill = self._skills.from_action(actions)
        total = super().advance(self._skills.actions(self.previous, self.positions, skill))
        for _ in range(self.steps_per_action - 1):
            step = super().advance(self._skills.actions(self.previous, self.positions, skill))
            goes_on = ~total.ended
            last = goes_on[:, None]
            total = total._replace(
                before=np.where(last, step.before, total.before),
                following=np.where(last, step.following, total.following),
                reward=np.where(goes_on, total.reward + step.reward, total.reward),
                ended=total.ended | step.ended,
                success=np.where(goes_on, step.success, total.success),
            )
        return total
