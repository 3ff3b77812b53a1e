"""Disturbances around any robot and any pose source: delays, noise and an offset, to try a bridge with."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from pydantic import Field

from service.config.frozen import FrozenModel
from service.robot.interface import Command, ObjectPose, PoseSource, RobotInterface, RobotState

_SAME_TIME_S = 1e-9
_Measurement = TypeVar("_Measurement", RobotState, ObjectPose)


class DisturbanceConfig(FrozenModel):
    """What is put between a robot and its bridge; nothing by default."""

    state_delay_s: float = Field(0.0, ge=0.0, le=1.0, description="age of what is read of the robot")
    command_delay_s: float = Field(0.0, ge=0.0, le=1.0, description="from a command to the robot")
    pose_delay_s: float = Field(0.0, ge=0.0, le=1.0, description="age of the objects' poses")
    pose_noise_m: float = Field(0.0, ge=0.0, le=0.1, description="standard deviation on each axis, anew in each pose")
    pose_offset_m: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="constant error of poses")


def _as_of(time_s: float, kept: deque[_Measurement]) -> _Measurement:
    """The newest measurement of that time or before; those before it are dropped.

    Where there is none yet, the oldest that there is, as if it were of that time: a camera that is late does not show a
    still picture before its first one.
    """
    while len(kept) > 1 and kept[1].time_s <= time_s + _SAME_TIME_S:
        kept.popleft()
    return kept[0] if kept[0].time_s <= time_s + _SAME_TIME_S else replace(kept[0], time_s=time_s)


class DisturbedRobot:
    """A robot that hears and tells everything late; it still stops at once.

    What is read is as old as asked only if it is read often, as the control loop does: nothing is measured in between.
    """

    def __init__(self, robot: RobotInterface, config: DisturbanceConfig) -> None:
        self._robot, self._config = robot, config
        self._states: deque[RobotState] = deque()
        self._commands: deque[tuple[float, Command]] = deque()

    def now_s(self) -> float:
        """Read the robot's clock, seconds."""
        return self._robot.now_s()

    def read(self) -> RobotState:
        """The robot as it was ``state_delay_s`` ago."""
        self._states.append(self._robot.read())
        return _as_of(self.now_s() - self._config.state_delay_s, self._states)

    def command(self, command: Command) -> None:
        """Keep a set-point until it is due; ``wait_until`` hands it on."""
        if not self._config.command_delay_s:
            self._robot.command(command)
            return
        self._commands.append((self.now_s() + self._config.command_delay_s, command))

    def wait_until(self, time_s: float) -> None:
        """Sleep, and hand on the commands that are due meanwhile."""
        while self._commands and self._commands[0][0] <= time_s + _SAME_TIME_S:
            due_s, command = self._commands.popleft()
            self._robot.wait_until(due_s)
            self._robot.command(command)
        self._robot.wait_until(time_s)

    def forget(self) -> None:
        """Begin anew: nothing was read or commanded before."""
        self._states.clear()
        self._commands.clear()

    def stop(self) -> None:
        """Forget the commands that wait, and halt."""
        self._commands.clear()
        self._robot.stop()

    def close(self) -> None:
        """Give the robot back."""
        self._robot.close()


class DisturbedPoses:
    """A pose source that is late, noisy and off.

    Args:
        poses: what really sees the object.
        now_s: the robot's clock.
        config: how much.
        num_objects: K that are seen.
        seed: of the noise, which depends on nothing but the number of different poses that were read.
    """

    def __init__(
        self,
        poses: PoseSource,
        now_s: Callable[[], float],
        config: DisturbanceConfig,
        *,
        num_objects: int = 1,
        seed: int = 0,
    ) -> None:
        self._poses, self._now_s, self._config, self._size = poses, now_s, config, 3 * num_objects
        self._rng = np.random.default_rng(seed)
        self._seen: deque[ObjectPose] = deque()

    def read(self) -> ObjectPose:
        """The objects as they were ``pose_delay_s`` ago, each with noise and offset."""
        pose = self._poses.read()
        if pose is None or np.shape(pose.position_m) != (self._size,):
            return pose  # what is wrong with it is the watchdog's to say
        if not self._seen or pose.time_s != self._seen[-1].time_s:
            offset = np.tile(self._config.pose_offset_m, self._size // 3)
            noise = self._rng.normal(0.0, self._config.pose_noise_m, self._size) if self._config.pose_noise_m else 0.0
            place = np.asarray(pose.position_m, dtype=np.float64)  # None becomes NaN
            self._seen.append(replace(pose, position_m=place + offset + noise))
        return _as_of(self._now_s() - self._config.pose_delay_s, self._seen)

    def forget(self) -> None:
        """Begin anew: nothing was seen before."""
        self._seen.clear()

    def close(self) -> None:
        """Let go of what sees the object."""
        self._poses.close()
