"""What a bridge needs of a robot and of whatever sees the objects. Positions are in the world frame of the primitives.

The world's origin is the table top, 0.6 m in front of the robot's base: x away from the base, z up. A back-end converts
from its own frame, and gives times by the clock that its ``now_s`` reads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from service.base.types import StateArray


@dataclass(frozen=True, slots=True)
class RobotState:
    """Measurement of a robot at one moment."""

    time_s: float
    """When it was measured."""
    effector_m: StateArray
    """(3,) point between the fingertips."""
    fingers_m: StateArray
    """(2,) opening of the left and of the right finger, each from the middle; 0 is closed."""
    connected: bool = True
    """False once the robot reports that it takes no more commands."""


@dataclass(frozen=True, slots=True)
class ObjectPose:
    """Measurement of the K objects of a policy's world at one moment."""

    time_s: float
    position_m: StateArray
    """(3 K,) their centres, in the order of the world's objects; NaN where one was not seen."""


@dataclass(frozen=True, slots=True)
class Command:
    """Where a robot should go until the next command."""

    effector_m: StateArray
    """(3,) set-point of the point between the fingertips; the gripper points down."""
    width_m: float
    """Distance between the fingertips; 0 is closed."""
    grip_force_n: float = 40.0
    """Most that the fingers press with, where the robot can be told; 40 N are those of the Panda in training."""


class RobotInterface(Protocol):
    """A robot arm with a parallel gripper that takes set-points in Cartesian space."""

    def now_s(self) -> float:
        """Read the robot's clock, seconds; simulators have their own."""

    def read(self) -> RobotState:
        """Measure the robot; never waits for longer than a few milliseconds.

        Raises:
            RobotError: no answer.
        """

    def command(self, command: Command) -> None:
        """Take a new set-point; returns at once.

        Raises:
            RobotError: refused.
        """

    def wait_until(self, time_s: float) -> None:
        """Sleep until ``now_s()`` is ``time_s``; a simulator steps its physics instead."""

    def stop(self) -> None:
        """Halt as fast as the robot can, and hold; never raises, and may be called at any time, also twice."""

    def close(self) -> None:
        """Give the robot back; it holds where it is."""


class PoseSource(Protocol):
    """Whatever sees the objects: a tracker, a camera with markers, a simulator."""

    def read(self) -> ObjectPose:
        """Return the newest measurement, which may be old; never waits."""

    def close(self) -> None:
        """Let go of cameras and sockets."""
