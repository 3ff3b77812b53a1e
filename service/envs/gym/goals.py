"""Goals of the environments' users: where they are drawn, one that is given at a reset, and what counts as success."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from service.base.errors import TandemError, in_metres
from service.base.types import Array, BoolArray, StateArray
from service.config import WorldConfig
from service.envs.reach import Reach
from service.envs.sampling import (
    GOAL_KINDS,
    GoalKind,
    Places,
    check_goals,
    draw_goals,
    inside_fixtures,
    inside_obstacles,
)

GoalSampler = Callable[[np.random.Generator, int, WorldConfig], Any]
"""Draws goals: (random numbers, how many, the world) to (num, 3), metres."""
GoalBox = Sequence[Sequence[float]]
"""The lowest and the highest corner of a box, (x, y, z) each, metres."""
Goals = GoalKind | GoalSampler | GoalBox
Success = Callable[[Array, Array], Any]
"""What counts: (..., 3) achieved and (..., 3) desired goals, metres, to (...) bool."""

_MAX_DRAWS = 1000


class GoalSource:
    """Draws goals, and checks those that come from a user.

    Args:
        goals: kind of goals, a function that draws them, or a box to draw them from.
        config: the world.
        reach: of its arm.
        success_distance_m: greatest distance that counts as reached.

    Raises:
        TandemError: an unknown kind, one that the world cannot have, or a box that is none or out of reach.
    """

    def __init__(self, goals: Goals, config: WorldConfig, reach: Reach, success_distance_m: float) -> None:
        self._config, self._reach, self._success_distance_m = config, reach, success_distance_m
        self._goals = goals
        if isinstance(goals, str):
            check_goals(goals, config)
        elif not callable(goals):
            self._check_box(np.array(goals, dtype=np.float64))

    def draw(self, rng: np.random.Generator, places: Places) -> StateArray:
        """(N, 3) goals for N worlds whose things are at ``places``, metres.

        Those of a function or a box are drawn again where they are out of reach, or inside something.

        Raises:
            TandemError: a function that drew something else, or no goal that is within reach and clear.
        """
        if isinstance(self._goals, str):
            return draw_goals(self._goals, rng, self._config, self._success_distance_m, places)
        goal = self._sample(rng, len(places.object))
        for _ in range(_MAX_DRAWS):
            wrong = self._out_of_reach(goal) | inside_fixtures(goal, self._config)
            wrong |= inside_obstacles(goal, places.obstacles, self._config)
            if not wrong.any():
                return goal
            goal[wrong] = self._sample(rng, int(wrong.sum()))
        raise TandemError(f"goals = {self._goals!r}: no place in it is within reach and clear: choose others")

    def given(self, options: dict[str, Any] | None, num: int) -> StateArray | None:
        """(num, 3) goals that ``options`` of a reset give, metres; None where they give none.

        Raises:
            TandemError: another option, or a goal of another shape, out of reach or inside a fixture.
        """
        for name in (options or {}).keys() - {"goal"}:
            raise TandemError(f"reset: unknown option {name!r}; the only one is goal")
        if not options or options["goal"] is None:
            return None
        goal = np.array(options["goal"], dtype=np.float64)
        if goal.shape not in ((3,), (num, 3)):
            raise TandemError(f"reset: options['goal'] has shape {goal.shape}, not (3,) or {(num, 3)}: give metres")
        goal = goal.reshape(-1, 3)
        self._check_reach("reset: options['goal']", goal)
        for bad in goal[inside_fixtures(goal, self._config)]:
            raise TandemError(
                f"reset: options['goal'] ({in_metres(bad)}) m: the object would be inside a fixture, or the upright "
                "box around it"
            )
        return goal

    def _sample(self, rng: np.random.Generator, num: int) -> StateArray:
        """(num, 3) goals of the user's function or box, metres."""
        if not callable(self._goals):
            lower, upper = np.array(self._goals, dtype=np.float64)
            return rng.uniform(lower, upper, (num, 3))
        goal = np.array(self._goals(rng, num, self._config), dtype=np.float64)
        if goal.shape != (num, 3):
            raise TandemError(f"goals: the function's goal has shape {goal.shape}, not {(num, 3)}: give metres")
        return goal

    def _check_box(self, box: StateArray) -> None:
        if box.shape != (2, 3):
            raise TandemError(
                f"goals = {self._goals!r}; choose one of {', '.join(GOAL_KINDS)}, a function (rng, num, world) -> "
                "(num, 3), or a box ((x, y, z), (x, y, z)): its lowest and its highest corner, metres"
            )
        if (box[0] > box[1]).any():
            raise TandemError(
                f"goals = {self._goals!r}: the first corner of a box is the lowest: no number above the second"
            )
        self._check_reach("goals: the box's corner", np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3))

    def _check_reach(self, what: str, goal: StateArray) -> None:
        for bad in goal[self._out_of_reach(goal)]:
            near = in_metres(self._nearest(bad[None])[0])
            raise TandemError(f"{what} ({in_metres(bad)}) m is out of reach: the nearest the arm comes is ({near}) m")

    def _nearest(self, goal: StateArray) -> StateArray:
        """(N, 3) where the object can be brought, nearest to (N, 3); on the table it may be lower than the arm."""
        raised = np.maximum(goal, [-np.inf, -np.inf, self._config.rest_height_m])
        reached = self._reach.clip(raised)
        reached[:, 2] = np.minimum(raised[:, 2], self._reach.height[-1])
        return reached

    def _out_of_reach(self, goal: StateArray) -> BoolArray:
        near: BoolArray = np.linalg.norm(self._nearest(goal) - goal, axis=1) <= self._success_distance_m
        return ~near  # what is no number is out of reach, too
