"""A hand-written policy for each downstream task: what must be possible before anything can learn it.

It sees what a learner's policy does not, exact positions at any time and where the box is, and acts as one does: four
numbers in [-1, 1] a step. Success counts as in the paper's table, within 5 cm of the goal at the last step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.config import WorldConfig
from service.config.run import SUCCESS_DISTANCE_M
from service.envs import scene
from service.envs.batch import DISPLACEMENT_M, WorldBatch
from service.envs.observations import ACTION, each_object
from service.envs.sampling import draw_goals
from service.envs.task import EPISODE_STEPS
from service.envs.tasks import find_task

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

OPEN, CLOSE = 1.0, -1.0
_GRASP_BELOW_M, _PUSH_HEIGHT_M = 0.003, 0.02
_ABOVE_M = 0.025
"""Least space between what is carried and what it is carried over."""
_NEAR_M = 0.012
_CLOSE_STEPS = 3
_DROPPED_M = 0.03
_BEHIND_M = 0.068
"""From the object to where the closed gripper is lowered: half a cube's diagonal, half a gripper, and some space."""
_PRESS_M = 0.012
"""While it pushes, the gripper is sent to a place behind the object that is this near: it never gets there."""
_ARRIVED_M, _LEFT_M = 0.03, 0.045
_LOST_M = 0.022
"""A gripper that is so far beside the line to the goal goes round again."""


@dataclass
class Scripted:
    """Picks and places, or pushes where the gripper is blocked; keeps the phase of each world."""

    worlds: WorldBatch
    goal: Array
    """(N, 3) metres."""
    index: int = 0
    """Of the object, where there are several."""
    over_m: float = 0.0
    """Height of what it is carried over, where that is no fixture; then it is let go of at the goal, too."""

    def __post_init__(self) -> None:
        self.phase = np.zeros(self.worlds.num_worlds, dtype=np.int64)
        self.waited = np.zeros(self.worlds.num_worlds, dtype=np.int64)
        self.travel_m = self.worlds.config.start_height_m

    @property
    def object_position(self) -> Array:
        """(N, 3) of the object that it handles, metres."""
        return each_object(self.worlds.object_position)[:, self.index]

    def act(self) -> NDArray[np.float32]:
        """(N, 4) the next actions."""
        return self.towards(*(self._push() if self.worlds.config.gripper == "blocked" else self._pick()))

    def towards(self, target: Array, grip: Array) -> NDArray[np.float32]:
        """(N, 4) actions that bring the grippers to (N, 3), metres, with (N,) finger commands."""
        actions = np.empty((self.worlds.num_worlds, 4), dtype=np.float32)
        actions[:, :3] = np.clip((target - self.worlds.ee_position) / DISPLACEMENT_M, -1.0, 1.0)
        actions[:, 3] = grip
        return actions

    def _pick(self) -> tuple[Array, Array]:
        """Above the object, down, close, up where something is in the way, across, down, and open over a box."""
        ee, obj = self.worlds.ee_position, self.object_position
        hold = ee - obj
        self.phase[(self.phase > 2) & (self.phase < 6) & (np.linalg.norm(hold, axis=1) > _DROPPED_M)] = 0
        self.waited[self.phase < 2] = 0
        carry_m = self._carry_height()
        over = np.linalg.norm((obj - self.goal)[:, :2], axis=1) < _NEAR_M
        above_object = self.worlds.reach.clip(_at_height(obj, self.travel_m))
        at_object = obj - [0.0, 0.0, _GRASP_BELOW_M]
        up, across = _at_height(obj, carry_m) + hold, _at_height(self.goal, carry_m) + hold
        release_m = self._release_height()
        place = np.maximum(self.goal, _at_height(self.goal, release_m)) + hold
        targets = np.stack([above_object, at_object, at_object, up, across, place, ee])
        grips = np.array([OPEN, OPEN, CLOSE, CLOSE, CLOSE, CLOSE, OPEN])
        self.waited[self.phase == 2] += 1
        done = np.stack(
            [
                np.linalg.norm((ee - above_object)[:, :2], axis=1) < _NEAR_M,
                ee[:, 2] < at_object[:, 2] + 0.006,
                self.waited >= _CLOSE_STEPS,
                obj[:, 2] > carry_m - 0.01,
                over,
                (obj[:, 2] < release_m + (0.002 if self.over_m else 0.01)),
                np.zeros(len(obj), dtype=bool),
            ]
        )
        if self.worlds.config.fixture == "none" and not self.over_m:
            done[3] = done[4] = True
        return self._advance(targets, grips, done)

    def _push(self) -> tuple[Array, Array]:
        """Above a place behind the object, down, then towards the goal; where the object slips aside, round again."""
        ee, obj = self.worlds.ee_position, self.object_position
        way = (self.goal - obj) * [1.0, 1.0, 0.0]
        distance = np.linalg.norm(way, axis=1)
        way /= np.maximum(distance, 1e-9)[:, None]
        behind = self.worlds.reach.clip(obj - _BEHIND_M * way)
        pressing = obj - _PRESS_M * way
        arrived = distance < np.where(self.waited > 0, _LEFT_M, _ARRIVED_M)
        self.waited[:] = arrived
        offset = (ee - obj)[:, :2]
        beside = np.abs(offset[:, 0] * way[:, 1] - offset[:, 1] * way[:, 0])
        lost = (self.phase == 2) & ((beside > _LOST_M) | ((offset * way[:, :2]).sum(axis=1) > 0)) & ~arrived
        self.phase[lost] = 0
        low = np.where(arrived[:, None], ee, _at_height(pressing, _PUSH_HEIGHT_M))
        targets = np.stack([_at_height(behind, self.travel_m), _at_height(behind, _PUSH_HEIGHT_M), low])
        done = np.stack(
            [
                np.linalg.norm((ee - behind)[:, :2], axis=1) < _NEAR_M,
                ee[:, 2] < _PUSH_HEIGHT_M + 0.01,
                np.zeros(len(obj), dtype=bool),
            ]
        )
        return self._advance(targets, np.zeros(3), done)

    def _advance(self, targets: Array, grips: Array, done: Bools) -> tuple[Array, Array]:
        """Go on to the next phase where one is done, through several at once; what the phase then asks for."""
        worlds = np.arange(self.worlds.num_worlds)
        for _ in range(len(done)):
            self.phase += done[self.phase, worlds]
        return targets[self.phase, worlds], grips[self.phase]

    def _carry_height(self) -> float:
        """Height of the object's centre on its way."""
        highest = {"none": 0.0, "wall": scene.WALL_HEIGHT_M, "box": scene.BOX_HEIGHT_M}
        return max(highest[self.worlds.config.fixture], self.over_m) + self.worlds.config.object_size_m / 2 + _ABOVE_M

    def _release_height(self) -> Array | float:
        """Height of the object's centre at which it is let go of; the fingertips are 1 cm below its middle at most."""
        if self.over_m:
            return self.goal[:, 2]
        # a box is entered no deeper than the fingers need to stay above its rim
        return scene.BOX_HEIGHT_M + 0.015 if self.worlds.config.fixture == "box" else -np.inf


def _at_height(position: Array, height_m: Array | float) -> Array:
    return np.column_stack([position[:, :2], np.broadcast_to(height_m, len(position))])


def play_task(
    task: str, config: WorldConfig, *, num_episodes: int, num_steps: int = EPISODE_STEPS, idle: bool = False
) -> Bools:
    """(N,) whether random episodes of a task, played by the script or by doing nothing, end with success."""
    config = find_task(task).world_from(config)
    rng = np.random.default_rng(0)
    with WorldBatch(config, num_episodes, num_threads=2) as worlds:
        worlds.reset(rng)
        goal = draw_goals(find_task(task).goals, rng, config, SUCCESS_DISTANCE_M, worlds.places)
        script = Scripted(worlds, goal)
        for _ in range(num_steps):
            worlds.step(np.zeros((num_episodes, ACTION.size), dtype=np.float32) if idle else script.act())
        return np.asarray(np.linalg.norm(worlds.object_position - goal, axis=1) <= SUCCESS_DISTANCE_M)
