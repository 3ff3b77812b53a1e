"""The reach of an arm: where its end effector can be commanded to.

It is found by following the arm outward and inward from the middle of its work, height by height, as its controller
would move it: as far as it still comes where it is sent, in the orientation that is asked of it. An arm that turns
about the vertical at its base, as nearly all do, reaches as far in every direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.base.errors import ConfigError, in_metres
from service.base.types import BoolArray, StateArray
from service.config import WorkspaceConfig
from service.config.robot import RobotConfig
from service.envs.kinematics import Chain

_STEP_M = 0.0025
_HEIGHT_M = 1.2
_LEAST_SHARE = 0.9
"""Of a workspace that has to be within reach; of the one of the task Larger, a Panda reaches 97 %."""
_MARGIN_M = 0.015
"""Distance kept from where the arm is straight, and from where it folds up."""
_NUM_HEIGHTS = 31
_NUM_ITERATIONS = 2
_WITHIN = 2e-3
"""Error, of position in metres and orientation in rad together, with which an arm still comes where it is sent."""


@dataclass(frozen=True)
class Reach:
    """Least and greatest distance from the base's axis, by height."""

    axis: StateArray
    """(2,) place of the base's axis, metres."""
    height: StateArray
    """(H,) rising, metres."""
    nearest: StateArray
    """(H,) metres."""
    furthest: StateArray
    """(H,) metres."""

    def clip(self, target: StateArray) -> StateArray:
        """Nearest point within reach of (N, 3) end-effector positions, metres: height first, then along the radius."""
        clipped = target.copy()
        np.clip(clipped[:, 2], self.height[0], self.height[-1], out=clipped[:, 2])
        away = clipped[:, :2] - self.axis
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-6)
        nearest = np.interp(clipped[:, 2], self.height, self.nearest)
        furthest = np.interp(clipped[:, 2], self.height, self.furthest)
        clipped[:, :2] = self.axis + away * (np.clip(distance, nearest, furthest) / distance)[:, None]
        return clipped

    def check(self, workspace: WorkspaceConfig, name: str, arm: Chain) -> None:
        """Check that nearly all of a workspace, from the least commanded height on, is within reach of a robot.

        Raises:
            ConfigError: it is not.
        """
        lower, upper = np.array(workspace.lower_m), np.array(workspace.upper_m)
        lower[2] = self.height[0]
        is_any_shape = bool(np.isinf(self.furthest).any())  # then the arm is sent there
        sides = [np.linspace(low, high, 7 if is_any_shape else 15) for low, high in zip(lower, upper, strict=True)]
        points = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 3)
        if is_any_shape:
            joints = arm.solve(np.tile(arm.home, (len(points), 1)), points, num_iterations=50)
            within, where = _arrives(arm, joints, points), ""
        else:
            within = np.linalg.norm(self.clip(points) - points, axis=1) < 1e-9
            x, y = self.axis
            where = (
                f", which is {self.nearest.min():.2f} to {self.furthest.max():.2f} m from x = {x:.2f}, y = {y:.2f} "
                f"where it is widest, and up to {self.height[-1]:.2f} m high"
            )
        if (share := float(within.mean())) < _LEAST_SHARE:
            raise ConfigError(
                f"robot {name}: {1.0 - share:.0%} of the workspace is out of its reach{where}: make world.workspace "
                "smaller, or change the robot's base_position_m or the ranges of its joints"
            )


_found: dict[RobotConfig, Reach] = {}


def reach_of(robot: RobotConfig, arm: Chain) -> Reach:
    """The reach of a robot's arm; found once in a process, which takes a fifth of a second.

    Raises:
        ConfigError: the arm does not come to where it is sent at home.
    """
    if robot not in _found:
        _found[robot] = _find(robot, arm)
    return _found[robot]


def _find(robot: RobotConfig, arm: Chain) -> Reach:
    home = arm.forward(arm.home[None]).position[0]
    if arm.base_axis is None:  # its reach has another shape; its joints' limits are all that holds it back
        there = arm.solve(arm.home[None], home[None], num_iterations=50)
        if not _arrives(arm, there, home[None])[0]:
            raise _not_at_home(robot, arm, home)
        any_height = np.array([robot.lowest_m, robot.lowest_m + 10.0])
        return Reach(home[:2], any_height, np.zeros(2), np.full(2, np.inf))
    axis: StateArray = arm.base_axis
    radius = float(np.linalg.norm(home[:2] - axis))
    if radius < _MARGIN_M:
        raise ConfigError(
            f"robot {robot.name}: at home its end effector is at ({in_metres(home)}) m, on the axis of its base: bend "
            "the arm, so that home is a posture in the middle of its work"
        )
    outward = (home[:2] - axis) / radius
    heights: StateArray = np.linspace(robot.lowest_m, robot.lowest_m + _HEIGHT_M, _NUM_HEIGHTS)

    def targets(radii: StateArray, at: StateArray) -> StateArray:
        return np.column_stack([axis + radii[:, None] * outward, at])

    above_home = targets(np.full(_NUM_HEIGHTS, radius), heights)
    joints = arm.solve(np.tile(arm.home, (_NUM_HEIGHTS, 1)), above_home, num_iterations=50)
    first, last = _run(_arrives(arm, joints, above_home), int(np.argmin(np.abs(heights - home[2]))))
    if first == last:
        raise _not_at_home(robot, arm, home)
    heights, joints = heights[first:last], joints[first:last]
    ends = []
    for step_m in (-_STEP_M, _STEP_M):
        end, here, going = np.full(len(heights), radius), joints.copy(), np.arange(len(heights))
        while going.size:
            further = targets(end[going] + step_m, heights[going])
            found = arm.solve(here[going], further, num_iterations=_NUM_ITERATIONS)
            arrived = _arrives(arm, found, further) & (end[going] + step_m > 0.0)
            going, found = going[arrived], found[arrived]
            end[going] += step_m
            here[going] = found
        ends.append(end - np.sign(step_m) * _MARGIN_M)
    first, last = _run(ends[0] < ends[1], int(np.argmin(np.abs(heights - home[2]))))
    return Reach(axis, heights[first:last], ends[0][first:last], ends[1][first:last])


def _not_at_home(robot: RobotConfig, arm: Chain, home: StateArray) -> ConfigError:
    """Why an arm does not come to where it is at home."""
    for name, value, low, high in zip(robot.joints, arm.home, arm.lower, arm.upper, strict=True):
        if not low <= value <= high:
            return ConfigError(
                f"robot {robot.name}: home of {name!r} is {value:g}, and the joint goes from {low:.2f} to "
                f"{high:.2f}: give rad, or metres of one that slides"
            )
    return ConfigError(
        f"robot {robot.name}: from its home posture the arm does not come to ({in_metres(home)}) m with the "
        f"orientation {robot.orientation!r}: check home, effector and orientation"
    )


def _arrives(arm: Chain, joints: StateArray, targets: StateArray) -> BoolArray:
    arrived: BoolArray = np.linalg.norm(arm.errors(arm.forward(joints), targets), axis=1) < _WITHIN
    return arrived


def _run(there: BoolArray, around: int) -> tuple[int, int]:
    """First and last + 1 of neighbours that are all there, with ``around`` among them."""
    if not there[around]:
        return around, around
    missing = np.flatnonzero(~there)
    before, after = missing[missing < around], missing[missing > around]
    return int(before[-1]) + 1 if before.size else 0, int(after[0]) if after.size else len(there)
