"""Hand-written policies for tasks with two cubes: that each of them can be solved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.observations import ACTION, each_object
from service.envs.rules import Rules
from service.envs.task import Task
from tests.envs.scripted_tasks import CLOSE, OPEN, Array, Bools, Scripted

RED, BLUE = 0, 1
_RELEASED = 6
"""Phase of a script that has let go."""
_RISE_STEPS = 8
_LET_GO_STEPS = 3
_PUSH_M = 0.12
_UP_M = np.array([0.0, 0.0, 0.05])


class PickEach:
    """Brings objects to their goals, one after the other, and lets go of each."""

    def __init__(self, worlds: WorldBatch, goal: Array, order: Sequence[int], over_m: float) -> None:
        self._worlds = worlds
        self._scripts = [Scripted(worlds, each_object(goal)[:, index], index, over_m) for index in order]
        self._now = np.zeros(worlds.num_worlds, dtype=np.int64)
        self._waited = np.zeros(worlds.num_worlds, dtype=np.int64)

    def act(self) -> Array:
        """(N, 4) the next actions."""
        ee, actions = self._worlds.ee_position, np.empty((self._worlds.num_worlds, ACTION.size), dtype=np.float32)
        for index, script in enumerate(self._scripts):
            mine = self._now == index
            before = script.phase.copy()
            found = script.act()
            script.phase[~mine] = before[~mine]
            released = mine & (script.phase == _RELEASED)
            self._waited[released] += 1
            up = script.towards(ee + _UP_M, np.full(len(ee), OPEN))
            rising = released & (self._waited > _LET_GO_STEPS)
            actions[mine] = np.where(rising[:, None], up, found)[mine]
            if index + 1 < len(self._scripts):
                over = released & (self._waited > _LET_GO_STEPS + _RISE_STEPS)
                self._now[over], self._waited[over] = index + 1, 0
        return actions


class PushAside:
    """Pushes blue away along x with closed fingers, then brings red to its goal."""

    def __init__(self, worlds: WorldBatch, goal: Array) -> None:
        place = each_object(worlds.object_position)[:, BLUE]
        inwards = np.where(place[:, 0] < worlds.config.workspace.center_x_m, 1.0, -1.0)
        self._worlds = worlds
        self._push = Scripted(worlds, place + inwards[:, None] * [_PUSH_M, 0.0, 0.0], BLUE)
        self._pick = Scripted(worlds, each_object(goal)[:, RED], RED)
        self._left = np.full(worlds.num_worlds, _RISE_STEPS)

    def act(self) -> Array:
        """(N, 4) the next actions."""
        ee = self._worlds.ee_position
        target, _ = self._push._push()
        pushing = self._push.towards(target, np.full(len(ee), CLOSE))
        there = self._push.waited > 0
        self._left[there] -= 1
        risen = self._left < 0
        rising = self._push.towards(ee + _UP_M, np.full(len(ee), OPEN))
        before = self._pick.phase.copy()
        picking = self._pick.act()
        self._pick.phase[~risen] = before[~risen]
        away = there | (self._left < _RISE_STEPS)
        return np.where(risen[:, None], picking, np.where(away[:, None], rising, pushing))


def play(task: Task, world: WorldConfig, *, num_episodes: int, idle: bool = False) -> Bools:
    """(N,) whether episodes of a task with two cubes, played by a script or by doing nothing, end with success."""
    rng = np.random.default_rng(0)
    with WorldBatch(task.world_from(world), num_episodes, num_threads=2) as worlds:
        rules = Rules(task, worlds)
        worlds.reset(rng)
        rules.place(rng)
        goal = rules.draw(rng)
        order = (RED, BLUE) if task.title == "Sort" else (RED,)
        script = PushAside(worlds, goal) if task.title == "Clear" else PickEach(worlds, goal, order, 0.05)
        for _ in range(task.episode_steps):
            worlds.step(np.zeros((num_episodes, ACTION.size), dtype=np.float32) if idle else script.act())
            rules.advance(goal)
        return rules.solved(goal)
