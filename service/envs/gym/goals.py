"""Goals of the environments' users: where they are drawn, one that is given at a reset, and what counts as success."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from service.base.errors import TandemError
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
            self._lower, self._upper = self._checked_box(goals)

    def draw(self, rng: np.random.Generator, places: Places) -> StateArray:
        """(N, 3) goals for N worlds whose things are at ``places``, metres.

        Raises:
            TandemError: a function that drew something else, or goals out of reach or inside a fixture.
        """
        if isinstance(self._goals, str):
            return draw_goals(self._goals, rng, self._config, self._success_distance_m, places)
        num = len(places.object)
        if callable(self._goals):
            goal = self._checked("goals: the function's goal", self._goals(rng, num, self._config), (num, 3))
            return self._clear("goals: the function's goal", goal)
        goal = self._from_box(rng, num)
        for _ in range(_MAX_DRAWS):
            wrong = self._out_of_reach(goal) | inside_fixtures(goal, self._config)
            wrong |= inside_obstacles(goal, places.obstacles, self._config)
            if not wrong.any():
                return goal
            goal[wrong] = self._from_box(rng, int(wrong.sum()))
        raise TandemError(f"goals = {self._goals!r}: no place in it is within reach and clear: choose another box")

    def given(self, options: dict[str, Any] | None, num: int) -> StateArray | None:
        """(num, 3) goals that ``options`` of a reset give, metres; None where they give none.

        Raises:
            TandemError: another option, or a goal of another shape, out of reach or inside a fixture.
        """
        for name in (options or {}).keys() - {"goal"}:
            raise TandemError(f"reset: unknown option {name!r}; the only one is goal")
        if not options or options["goal"] is None:
            return None
        goal = self._checked("reset: options['goal']", options["goal"], (3,), (num, 3))
        return self._clear("reset: options['goal']", goal)

    def _checked(self, what: str, value: Any, *shapes: tuple[int, ...]) -> StateArray:
        """Goals of one of these shapes as (N, 3), a copy."""
        goal = np.array(value, dtype=np.float64)
        if goal.shape not in shapes:
            known = " or ".join(str(shape) for shape in shapes)
            raise TandemError(f"{what} has shape {goal.shape}, not {known}: write x, y, z in metres")
        goal = goal.reshape(-1, 3)
        for bad in goal[self._out_of_reach(goal)]:
            near = _point(self._nearest(bad[None])[0])
            raise TandemError(f"{what} {_point(bad)} m is out of reach: the nearest the arm comes is {near} m")
        return goal

    def _clear(self, what: str, goal: StateArray) -> StateArray:
        """Goals that are not inside a fixture."""
        for bad in goal[inside_fixtures(goal, self._config)]:
            raise TandemError(
                f"{what} {_point(bad)} m: the object would be inside a fixture, or the upright box around it"
            )
        return goal

    def _checked_box(self, goals: GoalBox) -> tuple[StateArray, StateArray]:
        box = np.array(goals, dtype=np.float64)
        if box.shape != (2, 3):
            raise TandemError(
                f"goals = {goals!r}; choose one of {', '.join(GOAL_KINDS)}, a function (rng, num, world) -> (num, 3), "
                "or a box ((x, y, z), (x, y, z)): its lowest and its highest corner, metres"
            )
        if (box[0] > box[1]).any():
            raise TandemError(f"goals = {goals!r}: the first corner of a box is the lowest: no number above the second")
        corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)
        self._checked("goals: the box's corner", corners, corners.shape)
        return box[0], box[1]

    def _from_box(self, rng: np.random.Generator, num: int) -> StateArray:
        return rng.uniform(self._lower, self._upper, (num, 3))

    def _nearest(self, goal: StateArray) -> StateArray:
        """(N, 3) where the object can be brought, nearest to (N, 3); on the table it may be lower than the arm."""
        raised = np.maximum(goal, [-np.inf, -np.inf, self._config.rest_height_m])
        reached = self._reach.clip(raised)
        reached[:, 2] = np.minimum(raised[:, 2], self._reach.height[-1])
        return reached

    def _out_of_reach(self, goal: StateArray) -> BoolArray:
        near: BoolArray = np.linalg.norm(self._nearest(goal) - goal, axis=1) <= self._success_distance_m
        return ~near  # what is no number is out of reach, too


def succeeded(success: Success, achieved: Array, desired: Array) -> BoolArray:
    """(...) what a user's function says of (..., 3) goals.

    Raises:
        TandemError: it says something of another shape, or that is neither true nor false.
    """
    found = np.asarray(success(achieved, desired))
    shape = np.broadcast_shapes(achieved.shape, desired.shape)[:-1]
    if found.shape != shape or found.dtype != np.bool_:
        raise TandemError(
            f"success: the function gave {found.dtype} of shape {found.shape} for goals of shape {achieved.shape}; "
            f"give bool of shape {shape}"
        )
    return found


def _point(position: StateArray) -> str:
    return f"({', '.join(f'{each:.3g}' for each in position)})"
