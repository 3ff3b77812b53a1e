"""What watches a robot: over its measurements, late, frozen, jumping and missing ones, and a person with a key.

The key is a dead-man's switch: one of the terminal that has to be held down.
"""

from __future__ import annotations

import os
import select
import termios
import time
import tty
from contextlib import suppress
from typing import Self

import numpy as np
from pydantic import Field

from service.base.errors import TandemError
from service.base.types import BoolArray, StateArray
from service.config.frozen import FrozenModel
from service.envs.observations import distances, each_object
from service.robot.interface import ObjectPose, RobotState

_CLOCKS_AGREE_S = 0.02
_ROUNDING_S = 1e-6
"""Of times that are differences: what is 80 ms late has, at first, kept its time stamp for 80 ms."""

_RELEASED_S = 0.1
"""A key that is held repeats some 30 times a second; without one for so long it was let go."""
_HELD_S = 1.0
"""A key must be held so long before anything moves: terminals wait half a second before they repeat one."""


class WatchConfig(FrozenModel):
    """How old and how wrong measurements may be before the robot is stopped."""

    max_pose_age_s: float = Field(0.15, gt=0.0, le=2.0, description="of the newest pose that can be believed")
    max_frozen_s: float = Field(
        0.08, gt=0.0, le=2.0, description="for which measurements may keep their time stamp, or poses be missing"
    )
    max_object_speed_m_s: float = Field(3.0, gt=0.0, le=100.0, description="a cube that falls from 35 cm has 2.6")
    jump_allowance_m: float = Field(0.05, ge=0.0, le=1.0, description="added to what that speed allows: noise")
    max_jump_s: float = Field(0.08, gt=0.0, le=2.0, description="for which poses that jump are passed over")
    max_state_age_s: float = Field(0.1, gt=0.0, le=2.0, description="of what the robot says of itself")


class StateWatch:
    """Watches what a robot says of itself."""

    def __init__(self, config: WatchConfig) -> None:
        self._config = config
        self._stamp_s, self._new_s = -np.inf, -np.inf

    def check(self, state: RobotState, now_s: float) -> str | None:
        """What is wrong with a measurement, if anything."""
        if not state.connected:
            return "the robot takes no more commands"
        shapes = np.shape(state.effector_m), np.shape(state.fingers_m)
        if shapes != ((3,), (2,)):
            return (
                f"in the robot's state effector_m has the shape {shapes[0]} and fingers_m {shapes[1]}: give (3,), (2,)"
            )
        if not (np.isfinite(state.effector_m).all() and np.isfinite(state.fingers_m).all()):
            return "the robot's state is not finite"
        age_s = now_s - state.time_s
        if not age_s <= self._config.max_state_age_s:
            return f"the robot's state is {1e3 * age_s:.0f} ms old"
        if age_s < -_CLOCKS_AGREE_S:
            return f"the robot's state is of {-1e3 * age_s:.0f} ms in the future"
        if state.time_s != self._stamp_s:
            self._stamp_s, self._new_s = state.time_s, now_s
        if now_s - self._new_s > self._config.max_frozen_s + _ROUNDING_S:
            return f"the robot's state is frozen: no new one for {1e3 * (now_s - self._new_s):.0f} ms"
        return None


class PoseWatch:
    """Watches the poses of K objects, and keeps the last one that can be believed.

    A pose in which one is missing (NaN) or jumps is passed over, and the one before it stands in for a while.
    """

    def __init__(self, config: WatchConfig, num_objects: int) -> None:
        self._config = config
        self.position_m: StateArray = np.full(3 * num_objects, np.nan)
        """(3 K,) the last positions that can be believed; NaN before the first."""
        self.time_s = -np.inf
        """When that was measured."""
        self._stamp_s, self._new_s = -np.inf, -np.inf
        self._jumping_since_s: float | None = None
        self._missing_since_s: float | None = None
        self._gap_s = 0.0
        self._missing = self._jumping = "the object"

    def check(self, pose: ObjectPose, now_s: float) -> str | None:
        """Take a pose; what is wrong, if anything."""
        if not np.isfinite(pose.time_s) or pose.time_s - now_s > _CLOCKS_AGREE_S:
            return f"an object pose of {pose.time_s:.3f} s, at {now_s:.3f} s by the robot's clock: set the clocks alike"
        if (shape := np.shape(pose.position_m)) != self.position_m.shape:
            wanted = ", ".join(["x, y, z"] * (self.position_m.size // 3))
            return f"an object pose of the shape {shape}, not {self.position_m.shape}: {wanted}"
        if pose.time_s > self._stamp_s:
            self._stamp_s, self._new_s = pose.time_s, now_s
            self._take(pose, now_s)
        if not np.isfinite(self.time_s):
            return f"{self._missing} is not seen"
        if now_s - self._new_s > self._config.max_frozen_s + _ROUNDING_S:
            return f"the object's pose is frozen: no new one for {1e3 * (now_s - self._new_s):.0f} ms"
        if self._missing_since_s is not None and now_s - self._missing_since_s > self._config.max_frozen_s:
            return f"{self._missing} is not seen, for {1e3 * (now_s - self._missing_since_s):.0f} ms already"
        if self._jumping_since_s is not None and now_s - self._jumping_since_s > self._config.max_jump_s:
            return f"the pose of {self._jumping} jumps, for {1e3 * (now_s - self._jumping_since_s):.0f} ms already"
        if now_s - self.time_s > self._config.max_pose_age_s:
            return f"the object's newest pose is {1e3 * (now_s - self.time_s):.0f} ms old"
        return None

    def _take(self, pose: ObjectPose, now_s: float) -> None:
        place = np.asarray(pose.position_m, dtype=np.float64)  # None becomes NaN
        if not np.isfinite(place).all():
            self._missing = self._which(~np.isfinite(each_object(place)).all(axis=1))
            self._missing_since_s = now_s if self._missing_since_s is None else self._missing_since_s
            return
        self._missing_since_s = None
        if np.isfinite(self.time_s):
            far_m = distances(place, self.position_m)
            if self._jumping_since_s is None:
                self._gap_s = pose.time_s - self.time_s  # stays while it jumps: after a while any jump would be slow
            jumps = far_m > self._config.jump_allowance_m + self._config.max_object_speed_m_s * self._gap_s
            if jumps.any():
                self._jumping = self._which(jumps)
                self._jumping_since_s = now_s if self._jumping_since_s is None else self._jumping_since_s
                return
        self._jumping_since_s = None
        self.position_m, self.time_s = place.copy(), pose.time_s

    def _which(self, some: BoolArray) -> str:
        """The first of (K,) objects that are meant, in words."""
        return "the object" if len(some) == 1 else f"object {int(np.argmax(some)) + 1}"


class HeldKey:
    """True while any key of a terminal is held down.

    Args:
        descriptor: of the terminal; standard input by default.

    Raises:
        TandemError: it is no terminal.
    """

    def __init__(self, descriptor: int = 0) -> None:
        self._descriptor = descriptor
        if not os.isatty(descriptor):
            raise TandemError(
                "the dead-man's switch is a key, and standard input is no terminal: run in one, or give "
                "--dead-man none if your robot has a switch of its own"
            )
        self._pressed_s = -float("inf")

    def __enter__(self) -> Self:
        self._settings = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        return self

    def __exit__(self, *error: object) -> None:
        with suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(self._descriptor, termios.TCSAFLUSH, self._settings)

    def __call__(self) -> bool:
        """Whether a key is held now."""
        while select.select([self._descriptor], [], [], 0.0)[0]:
            if not os.read(self._descriptor, 1024):
                return False
            self._pressed_s = time.monotonic()
        return time.monotonic() - self._pressed_s <= _RELEASED_S

    def wait(self) -> None:
        """Return once a key has been held for a second."""
        since_s = time.monotonic()
        while time.monotonic() - since_s < _HELD_S:
            time.sleep(0.02)
            if not self():
                since_s = time.monotonic()
