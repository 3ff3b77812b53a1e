"""A Franka arm with its hand, by way of ``franky``: the extra ``franka``.

The arm follows set-points by franky's Cartesian impedance tracking: a controller at 1 kHz in a thread of the library's
own, to which a new target can be handed at any time. Franky's end effector is Franka's own, which with a Franka hand is
the point between the fingertips (0.1034 m from the flange). The hand takes no stream of set-points: a thread sends it
a new motion whenever the wanted width has changed enough. Nothing in a Franka sees the object: ``poses`` names what
does.
"""

from __future__ import annotations

import contextlib
import importlib
import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field

from service.base.errors import RobotError, TandemError, needs_extra, one_line
from service.config.frozen import FrozenModel
from service.config.world import Point, WorldConfig
from service.robot.backends import Backend
from service.robot.interface import Command, ObjectPose, PoseSource, RobotState

_DOWN = (1.0, 0.0, 0.0, 0.0)  # x y z w
_MOST_TURN_RAD = 0.2
_HAND_PERIOD_S = 0.02
_JOIN_S = 2.0
_STOP_S = 0.5
_MOST_MOTION_S = 3.0
"""All the way at half the greatest speed takes 1.6 s."""
_MOST_SILENT_S = 1.0
"""Of the hand. While it ends a motion nothing is measured, and that may take until the motion is over, 0.8 s."""


class FrankaParameters(FrozenModel):
    """Where the robot is, and how it is controlled."""

    host: str = Field(min_length=1, description="address of the robot's control unit")
    realtime: bool = Field(True, description="refuse to run without a real-time kernel; off for a simulator")
    base_position_m: Point = Field((-0.6, 0.0, 0.0), description="of the arm's base in the world of the primitives")
    translational_stiffness_n_m: float = Field(1500.0, gt=0.0, le=3000.0)
    rotational_stiffness_nm_rad: float = Field(80.0, gt=0.0, le=300.0)
    max_contact_force_n: float = Field(30.0, gt=0.0, le=100.0, description="of the arm; a greater one stops it")
    max_contact_torque_nm: float = Field(30.0, gt=0.0, le=100.0, description="of each joint; a greater one stops it")
    hand_speed_m_s: float = Field(0.1, gt=0.0, le=0.1)
    hand_tolerance_m: float = Field(0.004, gt=0.0, le=0.02, description="change of width that makes the hand move")
    poses: str | None = Field(
        None, description="module:function that makes a PoseSource of pose_parameters; None: nothing sees the object"
    )
    pose_parameters: dict[str, Any] = Field(default_factory=dict)


class FrankaRobot:
    """The arm and its hand as a ``RobotInterface``. Its clock is the computer's monotonic one.

    Args:
        franky: the library.
        parameters: where, and how.

    Raises:
        RobotError: it does not answer, has errors, or its gripper does not point down or is turned.
    """

    def __init__(self, franky: Any, parameters: FrankaParameters) -> None:
        self._franky, self._parameters = franky, parameters
        self._base = np.array(parameters.base_position_m)
        self._tracker: Any = None
        self._stopped = self._ended = False
        realtime = franky.RealtimeConfig.Enforce if parameters.realtime else franky.RealtimeConfig.Ignore
        with self._saying("connect"):
            self._robot = franky.Robot(parameters.host, realtime_config=realtime)
            if self._robot.has_errors:
                raise RobotError(self._words("it has errors: look at Desk, mend their cause, and unlock it again"))
            self._robot.set_collision_behavior(parameters.max_contact_torque_nm, parameters.max_contact_force_n)
            # In any direction: one that is turned about the vertical would be turned back by the first command.
            turn_rad = 2.0 * float(np.arccos(min(abs(float(np.ravel(self._pose().quaternion) @ _DOWN)), 1.0)))
            if not turn_rad <= _MOST_TURN_RAD:
                where = "pointing down with its left finger on the side of negative y"
                raise RobotError(self._words(f"its gripper is {turn_rad:.1f} rad off {where}: guide it there"))
            self._hand = Hand(franky.Gripper(parameters.host), parameters)

    def now_s(self) -> float:
        """Read the computer's clock, seconds."""
        return time.monotonic()

    def read(self) -> RobotState:
        """Measure the arm; the hand as its thread saw it last.

        The time is the arm's: by that of the hand, which measures nothing while it ends a motion, every such motion
        would stop the arm.

        Raises:
            RobotError: no answer, or none of the hand for longer than it needs to end a motion.
        """
        with self._saying("read"):
            tip = np.array(self._pose().translation).reshape(3) + self._base
            in_control = self._tracker is None or bool(self._tracker.is_running)
            connected = in_control and not self._robot.has_errors
        if self._hand.fault is not None:
            raise RobotError(self._words(f"hand: {self._hand.fault}"))
        if (silent_s := self.now_s() - self._hand.time_s) > _MOST_SILENT_S:
            raise RobotError(self._words(f"hand: no answer for {silent_s:.1f} s"))
        return RobotState(self.now_s(), tip, np.full(2, self._hand.width_m / 2), connected)

    def command(self, command: Command) -> None:
        """Take a new set-point; the first one begins the control of the arm.

        Raises:
            RobotError: refused, or stopped before.
        """
        if self._stopped:
            raise RobotError(self._words("it was stopped, and takes no commands until it is connected anew"))
        with self._saying("command"):
            target = self._franky.Affine(np.asarray(command.effector_m, dtype=float) - self._base, np.array(_DOWN))
            if self._tracker is None:
                self._tracker = self._franky.CartesianImpedanceTracker(
                    self._robot,
                    translational_stiffness=self._parameters.translational_stiffness_n_m,
                    rotational_stiffness=self._parameters.rotational_stiffness_nm_rad,
                )
            self._tracker.set_target(target)
        self._hand.go_to(command.width_m, command.grip_force_n)

    def wait_until(self, time_s: float) -> None:
        """Sleep."""
        time.sleep(max(time_s - self.now_s(), 0.0))

    def stop(self) -> None:
        """End the control of the arm, which brakes and holds; fingers that move halt, and those that hold go on."""
        self._stopped = True
        self._hand.halt()  # again, too: another thread may just have handed on a command
        # Whatever the library says now, the robot brakes by itself once it is not controlled.
        with contextlib.suppress(Exception):
            if not self._ended and self._tracker is not None and self._tracker.is_running:
                self._robot.move(self._franky.TorqueStopMotion(), asynchronous=True)
                self._ended = True

    def close(self) -> None:
        """Give the robot back."""
        self.stop()
        with contextlib.suppress(Exception):  # the end of a motion tells what went wrong in it, too
            self._robot.join_motion(_JOIN_S)
        self._hand.close()

    def _pose(self) -> Any:
        return self._robot.current_pose.end_effector_pose

    @contextlib.contextmanager
    def _saying(self, doing: str) -> Any:
        """Errors of the library as one line."""
        try:
            yield
        except RobotError:
            raise
        except Exception as error:
            raise RobotError(self._words(f"{doing}: {type(error).__name__}: {one_line(str(error), 300)}")) from error

    def _words(self, text: str) -> str:
        return f"robot franka at {self._parameters.host}: {text}"


class Hand:
    """A Franka hand that follows a wanted width, by single motions in a thread of its own.

    To close is to grasp: the fingers go to the wanted width and press where something is in the way. What is held stays
    held until a width is wanted that is greater than its own.
    """

    def __init__(self, gripper: Any, parameters: FrankaParameters) -> None:
        self._gripper, self._parameters = gripper, parameters
        self.width_m, self.time_s = float(gripper.width), time.monotonic()
        """Last measured, and when."""
        self.fault: str | None = None
        """Why it moves no longer."""
        self._wanted: tuple[float, float] | None = None  # width and force; None: to stand still
        self._sent_m, self._sent_s = self.width_m, 0.0
        self._running: Any = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True, name="franka-hand")
        self._thread.start()

    def go_to(self, width_m: float, force_n: float) -> None:
        """Take a new wanted width; returns at once."""
        self._wanted = (width_m, force_n)

    def halt(self) -> None:
        """Forget what was wanted, and let the thread end a motion that is under way; returns at once."""
        self._wanted = None

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._thread.join(_JOIN_S)

    def _follow(self) -> None:
        while not self._ended.wait(_HAND_PERIOD_S):
            try:
                self.advance()
            except Exception as error:  # whatever the library raises must reach the reader
                self.fault = one_line(f"{type(error).__name__}: {error}", 300)
                return

    def advance(self) -> None:
        """Measure, and send the next motion where one is due."""
        state = self._gripper.state
        self.width_m, self.time_s = float(state.width), time.monotonic()
        wanted = self._wanted
        if wanted is None:
            self._end_motion()
            return
        if self._is_moving() and time.monotonic() - self._sent_s > _MOST_MOTION_S:
            raise TimeoutError(f"a motion has not ended within {_MOST_MOTION_S:g} s")
        width_m, force_n = wanted
        change_m, tolerance_m = width_m - self._sent_m, self._parameters.hand_tolerance_m
        # What was sent is narrower than what is held: a width in between is no reason to let go.
        if abs(change_m) < tolerance_m or (state.is_grasped and width_m <= self.width_m + tolerance_m):
            return
        self._end_motion()
        self._sent_m, self._sent_s, speed = width_m, time.monotonic(), self._parameters.hand_speed_m_s
        if change_m > 0.0:
            self._running = self._gripper.move_async(width_m, speed)
        else:
            anything = float(self._gripper.max_width)
            self._running = self._gripper.grasp_async(width_m, speed, force_n, anything, anything)

    def _end_motion(self) -> None:
        if self._is_moving() and not self._gripper.stop_async().wait(_STOP_S):
            raise TimeoutError(f"it was told to stop, and has not answered within {_STOP_S:g} s")
        self._running = None

    def _is_moving(self) -> bool:
        return self._running is not None and not self._running.wait(0.0)


class NoPoses:
    """A pose source that sees nothing: enough to calibrate, and a policy is stopped before it moves."""

    def __init__(self, num_objects: int) -> None:
        self._nowhere = np.full(3 * num_objects, np.nan)

    def read(self) -> ObjectPose:
        """Return a pose of now that was not seen."""
        return ObjectPose(time.monotonic(), self._nowhere)

    def close(self) -> None:
        """Do nothing."""


def connect(world: WorldConfig, parameters: Mapping[str, Any]) -> Backend:
    """Make the back-end ``franka``.

    Raises:
        TandemError: a policy of another arm, the library is not installed, unknown parameters, no such pose source, or
            no answer.
    """
    if world.robot != "panda":
        raise TandemError(
            f"robot franka: the policy was trained with the arm {world.robot.name!r}; take one of the panda"
        )
    given = FrankaParameters.model_validate(parameters)
    with needs_extra("franka", "robot franka"):
        franky = importlib.import_module("franky")
    poses = _pose_source(given, world.num_objects)
    return Backend(FrankaRobot(franky, given), poses)


def _pose_source(given: FrankaParameters, num_objects: int) -> PoseSource:
    if given.poses is None:
        return NoPoses(num_objects)
    module, _, name = given.poses.partition(":")
    try:
        source: PoseSource = getattr(importlib.import_module(module), name)(**given.pose_parameters)
    except Exception as error:  # it is the user's own code
        raise TandemError(
            f"robot franka: poses = {given.poses!r} cannot be made: {one_line(str(error), 300)}; name module:function"
        ) from None
    return source
