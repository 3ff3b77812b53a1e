"""Episodes of a student, with what a teacher would have done who sees the world when a command counts.

Where a command of now counts in d steps, the right one depends on how the world will be then. The student's own
commands decide that, so the teacher is asked d steps later, about the true state, and his answer is the label of now.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from service.base.types import BoolArray, FloatArray, IntArray, StateArray
from service.config.distillation import DistillingConfig
from service.envs.batch import WorldBatch
from service.envs.observations import Layouts, bob_observation, distances
from service.envs.sampling import draw_goals
from service.policies.numpy_policy import NumpyMCPPolicy

_LEAST_LOG_WEIGHT = np.log(0.01)
"""Random weights are from here to 0 on a logarithmic scale, as those of an orchestrator."""
_HOLD_STEPS = 5
"""Env steps for which random weights are held."""
_NOISY_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class Lesson:
    """B observations of a student and the answers of his teacher; K primitives, A action components."""

    observation: FloatArray
    """(B, O)"""
    means: FloatArray
    """(B, K, A) of the teacher's primitives."""
    variances: FloatArray
    """(B, K, A)"""
    weights: FloatArray
    """(B, K) of his gate."""


@dataclass(frozen=True, slots=True)
class Episodes:
    """One of every world."""

    lesson: Lesson
    start: StateArray
    """(M, 3 K) where the objects were at first, in the episodes in which the student's own gate acted, metres."""
    goal: StateArray
    """(M, 3 K) of the same episodes, metres."""
    solved: BoolArray
    """(M,) whether all objects were there at the end."""
    num_env_steps: int
    diverged: tuple[tuple[StateArray, FloatArray], ...]
    """(last finite state, action) where physics diverged, which leaves a world as it was."""


class DistillationWorlds:
    """Worlds in which a student acts; they begin anew with every call.

    Args:
        config: the run, with ``distillation``.
        teacher: a trained Bob.
        seen: layouts of what the teacher sees.
        num_threads: native threads for physics; 0 for one per core.
    """

    def __init__(
        self, config: DistillingConfig, teacher: NumpyMCPPolicy, seen: Layouts, *, num_threads: int = 0
    ) -> None:
        self._config, self._how = config, config.distillation
        self._teacher, self._seen = teacher, seen
        self._worlds = WorldBatch(
            config.world,
            self._how.num_worlds,
            num_threads=num_threads,
            blocked_fraction=self._how.blocked_gripper_fraction,
        )
        self._most_late = (config.world.randomisation.delay_steps or (0, 0))[1]

    def close(self) -> None:
        """Stop the worlds' threads."""
        self._worlds.close()

    def play(self, student: NumpyMCPPolicy, rng: np.random.Generator) -> Episodes:
        """Play an episode in every world, and some steps more, so that each step of it has its label."""
        worlds, how = self._worlds, self._how
        num, distance_m = worlds.num_worlds, self._config.success_distance_m
        worlds.reset(rng)
        start = worlds.object_position.copy()
        goal = draw_goals(self._config.world.usual_goals, rng, self._config.world, distance_m, worlds.places)
        late: IntArray = np.zeros(num, dtype=np.int64)
        if self._most_late:
            late = worlds.states[:, worlds.layout["delay"]].ravel().astype(np.int64)
        composed = rng.random(num) < how.random_fraction
        steps = [self._step(student, goal, composed, step, rng) for step in range(how.episode_steps + self._most_late)]
        reached = np.all(distances(worlds.object_position, goal) <= distance_m, axis=1)
        answered = np.arange(how.episode_steps)[:, None] + late, np.arange(num)
        observation = np.stack([step.observation for step in steps[: how.episode_steps]])
        answers = (np.stack([getattr(step, each.name) for step in steps])[answered] for each in fields(Lesson)[1:])
        lesson = Lesson(*(_rows(array) for array in (observation, *answers)))
        own = ~composed
        diverged, worlds.diverged = tuple(worlds.diverged), []
        return Episodes(lesson, start[own], goal[own], reached[own], num * len(steps), diverged)

    def _step(
        self, student: NumpyMCPPolicy, goal: StateArray, composed: BoolArray, step: int, rng: np.random.Generator
    ) -> Lesson:
        """What the student sees, and what the teacher would do at once; then the student acts."""
        worlds, how = self._worlds, self._how
        positions, true = worlds.positions(), worlds.true_positions(self._seen)
        observation = bob_observation(positions, goal)
        means, variances = self._teacher.primitives(true)
        answer = Lesson(observation, means, variances, self._teacher.gate(bob_observation(true, goal)))
        if step % _HOLD_STEPS == 0:
            shape = worlds.num_worlds, student.num_primitives
            self._weights = np.exp(rng.uniform(_LEAST_LOG_WEIGHT, 0.0, shape)).astype(np.float32)
        weights = np.where(composed[:, None], self._weights, student.gate(observation))
        action, _ = student.compose(positions, weights)
        noisy = rng.random((len(action), 1)) < _NOISY_SHARE
        noise = how.action_noise * rng.standard_normal(action.shape, dtype=np.float32)
        worlds.step(action + np.where(noisy, noise, np.float32(0.0)))
        return answer


def _rows(array: FloatArray) -> FloatArray:
    """(T, N, ...) as (T * N, ...)."""
    return array.reshape(-1, *array.shape[2:])
