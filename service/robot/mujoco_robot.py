"""A robot in MuJoCo: the scene of training, with another arm, object or friction where one asks for it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from pydantic import Field

from service.base.errors import RobotError, TandemError
from service.base.types import StateArray
from service.config.frozen import FrozenModel
from service.config.world import WorldConfig
from service.envs.batch import MAX_SPEED, MAX_TURN_RAD, WorldBatch
from service.envs.observations import each_object
from service.envs.state_layout import object_columns, places_at
from service.robot.backends import Backend, ExactPoses
from service.robot.interface import Command, RobotState

_EARLY_S = 1e-9


class MujocoParameters(FrozenModel):
    """What differs from the world of training; nothing by default."""

    stiffness_scale: float = Field(1.0, gt=0.0, le=10.0, description="times the gains of the arm's servos")
    feed_forward: float = Field(
        0.0,
        ge=0.0,
        le=1.0,
        description="share of the servos' lag (damping / stiffness, 50 ms of the Panda in training) that is made good "
        "by the speed of the set-points, as the controllers of real arms do; for set-points without jumps",
    )
    joint_friction_nm: float = Field(0.0, ge=0.0, le=20.0, description="dry friction of the arm's joints")
    object_mass_kg: float | None = Field(
        None, gt=0.0, le=5.0, description="mass; of several objects of those that have none of their own"
    )
    object_size_m: float | None = Field(None, ge=0.02, le=0.07, description="edge or diameter, of one object")
    friction: float | None = Field(None, gt=0.0, le=3.0)
    pad_friction: float | None = Field(None, gt=0.0, le=3.0)
    physics_step_s: float | None = Field(None, gt=0.0, le=0.01, description="None: that of training")


class MujocoRobot:
    """One world as a ``RobotInterface`` and as a ``Simulator``. Its clock goes on while the loop waits.

    Args:
        world: of the policy.
        parameters: what is different here.

    Raises:
        TandemError: a world that cannot be built.
    """

    def __init__(self, world: WorldConfig, parameters: MujocoParameters | None = None) -> None:
        given = parameters or MujocoParameters()
        of_world = given.model_dump(include=set(WorldConfig.model_fields), exclude_none=True)
        self.world = WorldConfig.model_validate(world.model_dump() | of_world)
        with WorldBatch(self.world, 1, num_threads=1) as batch:
            self.model, self._robot, self._layout = batch.model, batch.robot, batch.layout
            self._reach = batch.reach
            self._start = batch.states[0].copy()
        self._fingers = slice(self._robot.num_joints, self._robot.num_joints + self._robot.num_fingers)
        """Their joints and their actuators."""
        self._fit(given)
        self._data = mujoco.MjData(self.model)
        self._stopped = False
        self._last: tuple[float, StateArray | None, StateArray] = (0.0, None, np.zeros(()))
        """When the joints got their last set-points, which, before they were moved on, and how fast these moved."""
        self._grip = self.model.actuator_forcerange[self._fingers].copy()
        self.reset(self._places(self._start).ravel())

    def _fit(self, given: MujocoParameters) -> None:
        """Change arm and motors of the compiled model."""
        arm = slice(0, self._robot.num_joints)
        self.model.actuator_gainprm[arm, 0] *= given.stiffness_scale
        self.model.actuator_biasprm[arm, 1] *= given.stiffness_scale
        self.model.dof_frictionloss[arm] += given.joint_friction_nm
        lag_s = -self.model.actuator_biasprm[arm, 2] / self.model.actuator_gainprm[arm, 0]
        self._lead_s = given.feed_forward * lag_s

    # --- the robot ---------------------------------------------------------------------------------------------------

    def now_s(self) -> float:
        """Read the physics' clock, seconds."""
        return float(self._data.time)

    def read(self) -> RobotState:
        """The robot as it is."""
        fingers = self._robot.openings(self._data.qpos[None, self._fingers])[0]
        return RobotState(self.now_s(), self._robot.arm.forward(self._joints()).position[0], fingers)

    def command(self, command: Command) -> None:
        """Send the servos to a set-point, as in training; after ``stop``, refuse until ``reset``.

        Raises:
            RobotError: it was stopped.
        """
        if self._stopped:
            raise RobotError("robot mujoco: it was stopped, and takes no commands until its next start")
        joints = self._joints()
        target = self._reach.clip(np.array(command.effector_m, dtype=np.float64)[None])
        solution = self._led(self._robot.arm.solve(joints, target))
        self._data.ctrl[: self._robot.num_joints] = np.clip(solution, joints - MAX_TURN_RAD, joints + MAX_TURN_RAD)[0]
        width_m = np.clip([command.width_m], 0.0, self._robot.widest_m)
        self._data.ctrl[self._fingers] = self._robot.finger_values(width_m)[0]
        most = np.where(self._robot.turning, np.inf, command.grip_force_n)[:, None]  # a torque is no force
        self.model.actuator_forcerange[self._fingers] = np.clip(self._grip, -most, most)

    def _led(self, solution: StateArray) -> StateArray:
        """Joint set-points moved on by what the servos lag behind at the speed of the set-points."""
        now_s, (before_s, before, speed) = self.now_s(), self._last
        if before is not None and now_s > before_s:  # a set-point may come before the physics made a step
            speed = (solution - before) / (now_s - before_s)
        self._last = (now_s, solution, speed)
        led: StateArray = solution + self._lead_s * speed
        return led

    def wait_until(self, time_s: float) -> None:
        """Step the physics.

        Raises:
            RobotError: it has diverged.
        """
        while self._data.time < time_s - _EARLY_S:
            mujoco.mj_step(self.model, self._data)
        if not (np.abs(self._data.qvel) < MAX_SPEED).all():  # NaN, too
            raise RobotError("robot mujoco: the physics has diverged; ask for a shorter physics_step_s")

    def stop(self) -> None:
        """Hold the joints where they are."""
        self._stopped = True
        self._data.ctrl[: self._robot.num_joints] = self._joints()[0]

    def close(self) -> None:
        """Nothing is left behind."""

    # --- the simulator -----------------------------------------------------------------------------------------------

    def reset(self, object_m: StateArray) -> None:
        """Put the arm to its start with an open gripper, objects on the table at (3 K,) metres; time goes on."""
        now_s, layout = self._data.time, self._layout
        state = self._start.copy()
        places = self._places(state)
        places[:, :2], places[:, 2] = each_object(object_m)[:, :2], self.world.rest_heights_m
        mujoco.mj_setState(self.model, self._data, state[layout.physics], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self._data.time, self._stopped = now_s, False
        self._last = (now_s, None, np.zeros(()))
        self._data.qacc_warmstart[:] = 0.0
        num = self._fingers.stop
        self._data.ctrl[:num] = self._data.qpos[:num]
        mujoco.mj_forward(self.model, self._data)

    def object_position(self) -> StateArray:
        """(3 K,) where the objects are, metres."""
        state = self._start.copy()
        mujoco.mj_getState(self.model, self._data, state[self._layout.physics], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        return self._places(state).ravel()

    def _places(self, state: StateArray) -> StateArray:
        """(K, 3) the objects' centres in a state; a view."""
        found: StateArray = places_at(state[None], object_columns(self._layout, self.world.num_objects))[0]
        return found

    def _joints(self) -> StateArray:
        """(1, J)."""
        joints: StateArray = self._data.qpos[None, : self._robot.num_joints].copy()
        return joints


def connect(world: WorldConfig, parameters: Mapping[str, Any]) -> Backend:
    """Make the back-end ``mujoco``.

    Raises:
        TandemError: unknown parameters, or a world that cannot be built.
    """
    if world.fixture == "box":
        raise TandemError("robot mujoco: the box is elsewhere in every episode, and nothing tells a bridge where")
    if world.obstacles:  # starts would be drawn into them
        raise TandemError("robot mujoco: obstacles are elsewhere in every episode, and nothing tells a bridge where")
    given = MujocoParameters.model_validate(parameters)
    if given.object_size_m is not None and (world.num_objects > 1 or not isinstance(world.object, str)):
        raise TandemError("robot mujoco: parameters: object_size_m is of one cube or sphere; these objects have theirs")
    robot = MujocoRobot(world, given)
    return Backend(robot, ExactPoses(robot, robot), robot)
