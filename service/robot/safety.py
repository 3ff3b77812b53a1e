"""Safety between policy and robot: bounds and watchdogs that no policy can pass, and a stop with its reason."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from pydantic import Field

from service.base.errors import ConfigError, RobotError, in_metres
from service.base.types import StateArray
from service.config.frozen import FrozenModel
from service.config.world import Point, WorldConfig
from service.envs.robot import described
from service.robot.interface import Command, PoseSource, RobotInterface, RobotState
from service.robot.limits import Box, SetPointLimiter
from service.robot.watchdogs import PoseWatch, StateWatch, WatchConfig

_NUM_TRIED = 5
_POLL_S = 0.01
_START_MARGIN_M = 0.01


class SafetyConfig(FrozenModel):
    """What a bridge lets through. Speed and acceleration are inside those of a Franka, 1.7 m/s and 13 m/s2."""

    lower_m: Point | None = Field(
        None, description="corner of the box of set-points; None: of the policy's workspace, less the margin"
    )
    upper_m: Point | None = Field(None, description="the other corner; None: of the workspace, with the margin")
    margin_m: float = Field(0.05, ge=0.0, le=0.3, description="of the box around the workspace, to the sides and up")
    lowest_m: float | None = Field(
        None, ge=0.0, le=0.5, description="least height of a set-point above the table; None: of the policy's robot"
    )
    max_speed_m_s: float = Field(1.7, gt=0.0, le=1e6, description="of the set-point")
    max_acceleration_m_s2: float = Field(
        11.0, gt=0.0, le=1e6, description="of the set-point; an arm that follows goes beyond by up to a seventh"
    )
    min_width_m: float = Field(0.0, ge=0.0, le=0.5, description="of the gripper")
    max_width_m: float | None = Field(None, ge=0.0, le=0.5, description="None: the opening of the policy's robot")
    max_grip_force_n: float = Field(40.0, gt=0.0, le=200.0)
    max_tracking_error_m: float = Field(
        0.15, gt=0.0, le=1.0, description="an arm further than this from its set-point is stuck, or not ours"
    )
    max_late_s: float = Field(0.03, gt=0.0, le=0.05, description="a control step or set-point later than this")
    watch: WatchConfig = WatchConfig()

    def box(self, world: WorldConfig) -> Box:
        """The box of set-points of a policy of a world.

        Raises:
            ConfigError: the corners are the wrong way round, or nothing is left above ``lowest_m``.
        """
        workspace, margin = world.workspace, np.full(3, self.margin_m)
        lower = np.array(workspace.lower_m) - margin if self.lower_m is None else np.array(self.lower_m)
        upper = np.array(workspace.upper_m) + margin if self.upper_m is None else np.array(self.upper_m)
        lower[2] = max(lower[2], described(world).lowest_m if self.lowest_m is None else self.lowest_m)
        box = Box(lower, upper)
        if (lower >= upper).any():
            raise ConfigError(f"safety: the box {box} is empty: raise upper_m, or lower lower_m or lowest_m")
        return box

    def widest_m(self, world: WorldConfig) -> float:
        """Greatest opening that is commanded for a policy of a world."""
        return described(world).opening_m if self.max_width_m is None else self.max_width_m


def always_held() -> bool:
    """A dead-man's switch that is always held, for simulators."""
    return True


class SafeRobot:
    """A robot behind its safety: every command goes through ``move`` or ``brake``, and any fault ends in ``stop``.

    Args:
        robot: what moves.
        poses: what sees the object; None where nothing has to.
        config: bounds.
        world: of the policy, whose workspace and robot say what the bounds leave open.
        held: the dead-man's switch: whether it is held now; asked at every tick, and returns at once.
        dry_run: command nothing.

    Raises:
        ConfigError: an empty box.
    """

    def __init__(
        self,
        robot: RobotInterface,
        poses: PoseSource | None,
        config: SafetyConfig,
        world: WorldConfig,
        *,
        held: Callable[[], bool] = always_held,
        dry_run: bool = False,
    ) -> None:
        self.config, self._robot, self._poses, self._held, self._dry_run = config, robot, poses, held, dry_run
        self.limiter = SetPointLimiter(config.box(world), config.max_speed_m_s, config.max_acceleration_m_s2)
        self._widest_m, self._num_objects = config.widest_m(world), world.num_objects
        if config.min_width_m > self._widest_m:
            raise ConfigError(
                f"safety.min_width_m = {config.min_width_m:g}: the gripper may open by {self._widest_m:g} m at most; "
                "give less"
            )
        self.stopped: str | None = None
        """Why the robot was stopped; None while it was not."""
        self.width_m = np.nan
        """Opening that was commanded last; at the start as it is."""
        self._expected_s = np.inf
        self._moved_s = np.nan

    # --- measuring ---------------------------------------------------------------------------------------------------

    def start(self, tick_s: float) -> None:
        """Begin where the robot is, at rest; all watchdogs begin anew.

        Args:
            tick_s: time between two set-points.

        Raises:
            RobotError: it does not answer or answers too late, is outside its box (but for a dry run, which shows
                where it is), the switch is not held, or the object is not seen.
        """
        self._state_watch, self.object = StateWatch(self.config.watch), PoseWatch(self.config.watch, self._num_objects)
        self.limiter.position_m = np.full(3, np.nan)  # nothing was commanded that the robot could be away from
        begin_s = self._robot.now_s()
        for _ in range(_NUM_TRIED):
            self.measure(self._robot.now_s())
        took_s = (self._robot.now_s() - begin_s) / _NUM_TRIED
        if took_s > tick_s:
            self._fail(
                f"it answers late: reading takes {1e3 * took_s:.1f} ms, and a set-point is due every "
                f"{1e3 * tick_s:.1f} ms: lower set_points_per_step"
            )
        inside = self.limiter.box.contains(self.state.effector_m, margin_m=_START_MARGIN_M)
        if not (inside or self._dry_run):
            self._fail(
                f"the gripper starts at ({in_metres(self.state.effector_m)}) m, outside the box {self.limiter.box}"
            )
        self.limiter.start(self.state.effector_m)
        self.width_m = float(self.state.fingers_m.sum())
        self._expected_s = self._robot.now_s()
        self._moved_s = self._expected_s - tick_s

    def measure(self, due_s: float) -> None:
        """Read robot and object into ``state`` and ``object``, and check them and the time.

        Args:
            due_s: when this should have happened.

        Raises:
            RobotError: the robot was stopped, now or before.
        """
        self._check_stopped()
        try:
            now_s = self._robot.now_s()
            fault = self._fault(now_s, due_s)
        except RobotError as error:
            self._fail(str(error))
        if fault is not None:
            self._fail(fault)

    def _fault(self, now_s: float, due_s: float) -> str | None:
        """What is wrong, if anything."""
        if now_s - due_s > self.config.max_late_s:
            return f"late: a step came {1e3 * (now_s - due_s):.0f} ms after it was due"
        if not self._held():
            return "the dead-man's switch was let go"
        state = self._robot.read()
        # a back-end may go on writing into its arrays
        effector_m, fingers_m = (np.array(each, dtype=np.float64) for each in (state.effector_m, state.fingers_m))
        self.state: RobotState = replace(state, effector_m=effector_m, fingers_m=fingers_m)
        pose = None if self._poses is None else self._poses.read()
        # Reading may have taken long; what was read is as old as it is now.
        now_s = self._robot.now_s()
        if now_s - due_s > self.config.max_late_s:
            return f"late: reading took until {1e3 * (now_s - due_s):.0f} ms after it was due"
        fault = self._state_watch.check(self.state, now_s)
        if fault is None and self._poses is not None:
            # A source of the user's own may return nothing once it sees nothing.
            fault = "no pose was read: return one of NaN" if pose is None else self.object.check(pose, now_s)
        if fault is not None:
            return fault
        away_m = float(np.linalg.norm(self.state.effector_m - self.limiter.position_m))
        if not self._dry_run and away_m > self.config.max_tracking_error_m:  # NaN before the start: no error
            return f"the gripper is {away_m:.3f} m from where it was sent"
        return None

    # --- moving ------------------------------------------------------------------------------------------------------

    def move(self, target_m: StateArray, width_m: float, arrive_s: float) -> None:
        """Send the next set-point on the way to a target.

        Args:
            target_m: (3,) wanted end effector, metres.
            width_m: wanted opening.
            arrive_s: time in which to arrive.

        Raises:
            RobotError: the robot was stopped, or the target is not finite.
        """
        self.check_finite(np.array([*target_m, width_m, arrive_s]), "a target")
        self._send(lambda gap_s: self.limiter.move(target_m, arrive_s, gap_s), width_m)

    def check_finite(self, numbers: StateArray, what: str) -> None:
        """Stop the robot if not all numbers are finite.

        Raises:
            RobotError: they are not.
        """
        if not np.isfinite(numbers).all():
            self._fail(f"{what} is not finite: {', '.join(f'{number:g}' for number in numbers)}")

    def brake(self) -> None:
        """Send the next set-point on the way to rest; errors are those of ``move``.

        The gripper's width stays as it was commanded: fingers that are sent to where they are press with nothing.
        """
        self._send(self.limiter.brake, self.width_m)

    def _send(self, advance: Callable[[float], StateArray], width_m: float) -> None:
        self._check_stopped()
        try:
            now_s = self._robot.now_s()
            set_point = advance(now_s - self._moved_s)
            self._moved_s = now_s
            self.width_m = float(np.clip(width_m, self.config.min_width_m, self._widest_m))
            if not self._dry_run:
                self._robot.command(Command(set_point.copy(), self.width_m, self.config.max_grip_force_n))
        except RobotError as error:
            self._fail(str(error))
        if self.stopped is not None and not self._dry_run:  # by the other thread, and maybe before this command
            self._robot.stop()
        self._check_stopped()

    def wait_until(self, time_s: float) -> None:
        """Wait for the next tick.

        Raises:
            RobotError: the robot was stopped.
        """
        self._expected_s = time_s  # the next sign of life
        try:
            self._robot.wait_until(time_s)
        except RobotError as error:
            self._fail(str(error))

    # --- stopping ----------------------------------------------------------------------------------------------------

    def stop(self, reason: str) -> None:
        """Halt the robot; the first reason counts."""
        self.stopped = self.stopped or reason
        if not self._dry_run:
            self._robot.stop()

    @contextmanager
    def guarded(self) -> Iterator[None]:
        """Stop the robot if the block ends by an error or a signal, or if it hangs: another thread looks after it."""
        ended = threading.Event()
        self._expected_s = np.inf
        thread = threading.Thread(target=self._look_after, args=(ended,), daemon=True, name="robot-watch")
        thread.start()
        try:
            yield
        except BaseException as error:
            self.stop(f"{type(error).__name__}: {error}")
            raise
        finally:
            ended.set()
            thread.join()

    def _look_after(self, ended: threading.Event) -> None:
        """Stop the robot once its clock says that the loop has not looked at it for too long."""
        while not ended.wait(_POLL_S):
            try:
                late_s = self._robot.now_s() - self._expected_s
            except Exception as error:  # without a clock nothing looks after it
                self.stop(f"the robot's clock cannot be read: {error}")
                return
            if self.stopped is None and late_s > self.config.max_late_s + _POLL_S:
                self.stop(f"late: the control loop hangs, for {1e3 * late_s:.0f} ms already")

    def _check_stopped(self) -> None:
        if self.stopped is not None:
            raise RobotError(f"stopped: {self.stopped}")

    def _fail(self, reason: str) -> None:
        self.stop(reason)
        self._check_stopped()
