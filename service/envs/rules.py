"""A task applied to worlds that are played: its goals, what is reached and paid, and what is remembered."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.base.errors import ConfigError, TandemError, in_metres
from service.base.types import Array, BoolArray, StateArray
from service.base.user_code import CodeError, checked, naming_errors_of, place_of, shown
from service.config.run import SUCCESS_DISTANCE_M
from service.envs.batch import WorldBatch
from service.envs.observations import distances, each_object
from service.envs.overlap import (
    inside_box,
    inside_each_other,
    inside_fixtures,
    inside_gripper_or_table,
    inside_obstacles,
    inside_table,
)
from service.envs.sampling import GoalKind, check_goals, draw_goals
from service.envs.task import Bodies, Task, View

_MAX_DRAWS = 1000
_ALL = slice(None)


class Rules:
    """What a task says of N worlds.

    Args:
        task: its functions may be run; or a kind of random goals, where nothing else is asked.
        worlds: N of them, of the task's world.
        success_distance_m: greatest distance to the goal that counts as reached, where the task does not say.

    Raises:
        TandemError: its functions may not be run, or goals that the world cannot have.
    """

    def __init__(
        self, task: Task | GoalKind, worlds: WorldBatch, success_distance_m: float = SUCCESS_DISTANCE_M
    ) -> None:
        self.task = Task("Goals", goals=task) if isinstance(task, str) else task
        if self.task.closed:
            raise CodeError(self.task.closed)
        if isinstance(self.task.goals, str):
            try:
                check_goals(self.task.goals, worlds.config, success_distance_m)
            except TandemError as error:
                raise (CodeError(f"{self.task.name}: {error}") if self.task.code else error) from None
        if self.task.starts is not None and worlds.config.num_objects > 1 and "object_size" in worlds.bank.drawn:
            raise ConfigError(
                f"{self.task.title}: its starts know objects of one size, and world.randomisation.object_size draws "
                "others: leave that out"
            )
        self._worlds, self._near_m = worlds, success_distance_m
        self.elapsed: NDArray[np.int64] = np.zeros(worlds.num_worlds, dtype=np.int64)
        """(N,) steps of the episode so far."""
        self.memory: StateArray = np.zeros((worlds.num_worlds, self.task.memory_size))
        """(N, M)"""

    def view(self, goal: StateArray) -> View:
        """What its functions see now, for (N, 3 K) goals, metres."""
        worlds, layout = self._worlds, self._worlds.layout
        objects = each_object(worlds.object_position), each_object(worlds.object_velocity)
        fingers = worlds.robot.openings(worlds.states[:, layout["fingers"]]).sum(axis=1)
        contacts = worlds.contacts().reshape(worlds.num_worlds, -1, 2)
        parts = worlds.ee_position, fingers, contacts, each_object(goal), self.elapsed, self.memory
        return View(Bodies(*map(shown, objects)), *map(shown, parts))

    def begin(self, worlds: BoolArray) -> None:
        """Begin new episodes in some worlds (N,)."""
        self.elapsed[worlds], self.memory[worlds] = 0, 0.0

    def draw(self, rng: np.random.Generator, worlds: slice = _ALL) -> StateArray:
        """(N, 3 K) goals for some worlds, metres.

        Those of a function are drawn again where they are out of reach, or inside something.

        Raises:
            CodeError: the function gives something else, or no goal that is within reach and clear.
        """
        if isinstance(self.task.goals, str):
            places = self._worlds.places.of(worlds)
            return draw_goals(self.task.goals, rng, self._worlds.config, self._near_m, places)
        return self._places("goals", rng, worlds)

    def place(self, rng: np.random.Generator, worlds: slice = _ALL) -> None:
        """Put objects where the task has them start, in worlds that are at a random start; it may say nothing.

        Where one is lower than it lies in its world, whose table and sizes may be drawn, all of the world are raised by
        as much. What stands on another one is not moved by its size.

        Raises:
            CodeError: the function gives something else, or no places that are within reach and clear.
        """
        if self.task.starts is not None:
            place = self._places("starts", rng, worlds)
            height = each_object(place)[:, :, 2]  # a view
            height += (self._worlds.rest_heights[worlds] - height).max(axis=1, keepdims=True).clip(min=0.0)
            self._worlds.put_objects(place, worlds)

    def _places(self, name: str, rng: np.random.Generator, worlds: slice) -> StateArray:
        """(N, 3 K) places by a function of the task; drawn again where they are out of reach, or inside something."""
        batch = self._worlds
        config, there = batch.config, batch.places.of(worlds)
        view = self.view(batch.object_position).of(worlds)
        place, wrong = view.goal.reshape(len(view.goal), -1).copy(), np.ones(len(view.goal), dtype=bool)
        for _ in range(_MAX_DRAWS):
            asked = view.of(wrong)
            found = self._asked(name, asked.objects.place.shape, asked, rng)
            place[wrong] = found.reshape(len(found), -1)
            reasons = {
                "out of reach, or inside the table": self.out_of_reach(place),
                "inside a fixture": inside_fixtures(place, config),
                "inside each other": inside_each_other(place, config),
                "inside an obstacle or the box": inside_obstacles(place, there.obstacles, config)
                | inside_box(place, there.box, config, bottom=name == "starts"),
            }
            if name == "starts":
                # It may know heights as they are in its world, or as the configuration has them.
                rest_m = np.minimum(config.rest_heights_m, batch.rest_heights[worlds])
                reasons["inside the gripper or the table"] = inside_gripper_or_table(
                    place, config, batch.gripper_at_start, rest_m
                )
            wrong = np.any([*reasons.values()], axis=0)
            if not wrong.any():
                return place
        where, first = place_of(getattr(self.task, name))[1], int(wrong.argmax())
        last = " and ".join(f"({in_metres(each)})" for each in each_object(place[first : first + 1])[0])
        why = next(words for words, found in reasons.items() if found[first])
        raise CodeError(
            f"{where}: {name} gave no place that is within reach and clear, in {wrong.sum()} of {len(wrong)} worlds, "
            f"{_MAX_DRAWS} times: at last {last} m, {why}; choose others, in metres and for the objects' centres"
        )

    def advance(self, goal: StateArray) -> None:
        """Count a step that was made, and update the memory."""
        self.elapsed += 1
        if self.task.remember is not None:
            self.memory = self._asked("remember", self.memory.shape, self.view(goal))

    def solved(self, goal: StateArray) -> BoolArray:
        """(N,) whether the worlds are as the task asks, for (N, 3 K) goals, metres."""
        return self.success(self.view(goal))

    def success(self, view: View) -> BoolArray:
        """(N,) whether the task's function says so; without one, whether each object is near its goal."""
        if self.task.success is None:
            near: BoolArray = np.linalg.norm(view.objects.place - view.goal, axis=2) <= self._near_m
            all_near: BoolArray = np.all(near, axis=1)
            return all_near
        found: BoolArray = self._asked("success", view.objects.place.shape[:1], view, truth=True)
        return found

    def reward(self, view: View) -> NDArray[np.float64]:
        """(N,) what the task's function pays for a step that led to ``view``; without one, 1 for success, else 0."""
        if self.task.reward is None:
            return self.success(view).astype(np.float64)
        paid: StateArray = self._asked("reward", view.objects.place.shape[:1], view)
        return paid

    def nearest(self, goal: StateArray) -> StateArray:
        """(N, 3 K) where objects can be brought, nearest to (N, 3 K); on the table it may be lower than the arm."""
        rest = [(-np.inf, -np.inf, height) for height in self._worlds.config.rest_heights_m]
        raised = np.maximum(each_object(goal), rest).reshape(-1, 3)
        reached = self._worlds.reach.clip(raised)
        reached[:, 2] = np.minimum(raised[:, 2], self._worlds.reach.height[-1])
        return reached.reshape(goal.shape)

    def out_of_reach(self, goal: StateArray) -> BoolArray:
        """(N,) whether the arm brings an object not as near to its place of (N, 3 K) goals as counts.

        So it is inside of the table, too: the place of an object is its centre.
        """
        near: BoolArray = np.all(distances(self.nearest(goal), goal) <= self._near_m, axis=1)
        return ~near | inside_table(goal, self._worlds.config)  # what is no number is out of reach, too

    def _asked(self, name: str, shape: tuple[int, ...], *given: Any, truth: bool = False) -> Array:
        function = getattr(self.task, name)
        origin, place = place_of(function)
        with naming_errors_of(origin):
            answer = function(*given)
        with naming_errors_of(place):
            found = np.asarray(answer)
        return checked(f"{place}: {name}", found, shape, truth=truth)
