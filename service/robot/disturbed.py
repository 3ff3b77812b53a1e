"""Disturbances around any robot and any pose source: delays, noise and an offset, to try a bridge with."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Generic, Protocol, TypeVar

import numpy as np
from pydantic import Field

from service.config.frozen import FrozenModel
from service.robot.interface import Command, ObjectPose, PoseSource, RobotInterface, RobotState

_SAME_TIME_S = 1e-9


class DisturbanceConfig(FrozenModel):
    """What is put between a robot and its bridge; nothing by default."""

    state_delay_s: float = Field(0.0, ge=0.0, le=1.0, description="age of what is read of the robot")
    command_delay_s: float = Field(0.0, ge=0.0, le=1.0, description="from a command to the robot")
    pose_delay_s: float = Field(0.0, ge=0.0, le=1.0, description="age of the object's pose")
    pose_noise_m: float = Field(0.0, ge=0.0, le=0.1, description="standard deviation on each axis, anew in each pose")
    pose_offset_m: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="constant error of poses")


class _Timed(Protocol):
    @property
    def time_s(self) -> float: ...


_Measurement = TypeVar("_Measurement", bound=_Timed)


class _History(Generic[_Measurement]):
    """Measurements in their order, read some time later; they keep their time stamps."""

    def __init__(self, delay_s: float) -> None:
        self._delay_s = delay_s
        self._kept: deque[_Measurement] = deque()

    def is_new(self, measurement: _Measurement) -> bool:
        return not self._kept or measurement.time_s != self._kept[-1].time_s

    def add(self, measurement: _Measurement) -> None:
        self._kept.append(measurement)

    def forget(self) -> None:
        self._kept.clear()

    def read(self, now_s: float) -> _Measurement:
        """The newest that is old enough, or else the oldest that there is."""
        while len(self._kept) > 1 and self._kept[1].time_s <= now_s - self._delay_s + _SAME_TIME_S:
            self._kept.popleft()
        return self._kept[0]


class DisturbedRobot:
    """A robot that hears and tells everything late; it still stops at once.

    What is read is as old as asked only if it is read often, as the control loop does: nothing is measured in between.
    """

    def __init__(self, robot: RobotInterface, config: DisturbanceConfig) -> None:
        self._robot, self._config = robot, config
        self._states: _History[RobotState] = _History(config.state_delay_s)
        self._commands: deque[tuple[float, Command]] = deque()

    def now_s(self) -> float:
        """Read the robot's clock, seconds."""
        return self._robot.now_s()

    def read(self) -> RobotState:
        """The robot as it was ``state_delay_s`` ago."""
        self._states.add(self._robot.read())
        return self._states.read(self.now_s())

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
        self._states.forget()
        self._commands.clear()

    def stop(self) -> None:
        """Forget the commands that wait, and halt."""
        self._commands.clear()
        self._robot.stop()

    def close(self) -> None:
        """Give the robot back."""
        self._commands.clear()
        self._robot.close()


class DisturbedPoses:
    """A pose source that is late, noisy and off.

    Args:
        poses: what really sees the object.
        now_s: the robot's clock.
        config: how much.
        seed: of the noise, which depends on nothing but the number of different poses that were read.
    """

    def __init__(
        self, poses: PoseSource, now_s: Callable[[], float], config: DisturbanceConfig, *, seed: int = 0
    ) -> None:
        self._poses, self._now_s, self._config = poses, now_s, config
        self._rng = np.random.default_rng(seed)
        self._seen: _History[ObjectPose] = _History(config.pose_delay_s)

    def read(self) -> ObjectPose:
        """The object as it was ``pose_delay_s`` ago, with noise and offset."""
        pose = self._poses.read()
        if self._seen.is_new(pose):
            noise = self._rng.normal(0.0, self._config.pose_noise_m, 3) if self._config.pose_noise_m else 0.0
            self._seen.add(replace(pose, position_m=pose.position_m + self._config.pose_offset_m + noise))
        return self._seen.read(self._now_s())

    def forget(self) -> None:
        """Begin anew: nothing was seen before."""
        self._seen.forget()

    def close(self) -> None:
        """Let go of what sees the object."""
        self._poses.close()
