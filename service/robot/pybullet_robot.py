"""A Panda and a cube in PyBullet, an engine with contacts and motors of its own: the extra ``pybullet``.

The arm is the one that panda-gym 3.0.7 uses, PyBullet's ``franka_panda/panda.urdf`` with panda-gym's frictions and
forces; so is its cube. Time is the engine's: it passes while the control loop waits. The two world frames have the same
origin and axes; the point between the fingertips is 1.6 mm nearer to the hand than the URDF's own grasp target.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field

from service.base.errors import ConfigError, RobotError, needs_extra
from service.base.types import StateArray
from service.config.frozen import FrozenModel
from service.config.world import WorldConfig
from service.robot.backends import Backend, ExactPoses
from service.robot.interface import Command, RobotState

CONTROL_STEP_S = 0.04
"""Time of one action of a policy, for which ``PyBulletParameters.response`` is given."""
PANDA_GYM_CUBE = {"object": "cube", "object_size_m": 0.04, "object_mass_kg": 1.0, "friction": 0.25}
"""Settings of a world with panda-gym's cube. PyBullet multiplies two frictions: 0.5 of the cube by 0.5 of the table."""

_BASE_M = (-0.6, 0.0, 0.0)
_ARM, _FINGERS = tuple(range(7)), (9, 10)  # the left finger first
_HAND, _GRASP_TARGET = 8, 11
_TIP_M = 0.1034
"""From the hand's frame to the effector, along its z axis; the grasp target is at 0.105."""
_GRASP_TARGET_M = 0.105
_DOWN = (1.0, 0.0, 0.0, 0.0)  # x y z w
_NEUTRAL = (0.0, 0.41, 0.0, -1.85, 0.0, 2.26, 0.79)
_ARM_FORCES = (87.0, 87.0, 87.0, 87.0, 12.0, 120.0, 120.0)
_STROKE_M = 0.04
_SURFACE_FRICTION, _FINGER_FRICTION, _FINGER_SPIN = 0.5, 1.0, 0.001
_TABLE_SIZE_M, _TABLE_X_M = (1.1, 0.7, 0.4), -0.3
_MAX_ITERATIONS, _RESIDUAL = 300, 1e-4  # less than 0.1 mm
_PHYSICS_STEP_S, _EARLY_S = 0.002, 1e-9
_POSITION_GAIN = 0.1
"""Share of its error that a joint's motor makes good in a physics step, as in panda-gym."""
_MAX_FINGER_FORCE_N = 140.0
"""Of each finger, whatever a command says; a Franka hand's greatest."""
_STIFF_LAG_S = 0.007
"""Time constant of stiff motors; that of the servos of our own world, to whose lag it also comes second."""
_STIFF_FORCE = 10.0
"""Forces of stiff motors, over panda-gym's: the URDF's inertias are far greater than a real arm's."""


class PyBulletParameters(FrozenModel):
    """Parameters of the motors and the cube. The defaults are panda-gym's."""

    response: float | None = Field(
        None,
        gt=0.0,
        le=1.0,
        description="share of the way to a set-point that the arm has gone after 40 ms, by a first-order lag before "
        "motors that are stiff; None: the motors alone, as in panda-gym",
    )
    cube: Literal["panda-gym", "world"] = Field(
        "panda-gym", description="size, mass and friction: 4 cm, 1 kg, 0.25 on the table, or what the world says"
    )


class PyBulletRobot:
    """The arm as a ``RobotInterface`` and as a ``Simulator``. Several may live in one process.

    Args:
        world: where the arm starts, its object and fixture; a cube, no fixture or the wall.
        parameters: of the engine.

    Raises:
        TandemError: PyBullet is not installed, or the world is one that it cannot show.
    """

    def __init__(self, world: WorldConfig, parameters: PyBulletParameters | None = None) -> None:
        self.parameters = parameters or PyBulletParameters()
        self.world = world_of(world, self.parameters)
        with needs_extra("pybullet", "robot pybullet"):  # Python 3.11 has a wheel of it
            import pybullet
            import pybullet_data
            from pybullet_utils.bullet_client import BulletClient
        self._bullet = BulletClient(pybullet.DIRECT)
        self._bullet.setAdditionalSearchPath(pybullet_data.getDataPath())
        self._build()
        self._set_joints(_NEUTRAL)
        self._home = self._solve(self._start_m())
        self._num_steps = 0
        self.num_touching_steps = 0
        """Physics steps in which the arm or its gripper touched the object, the table or a wall."""
        self._stopped = self._held = False
        self._follow, gain, strength = 1.0, _POSITION_GAIN, 1.0
        if self.parameters.response is not None:
            self._follow = 1.0 - math.exp(-_PHYSICS_STEP_S / lag_s(self.parameters.response))
            gain, strength = 1.0 - math.exp(-_PHYSICS_STEP_S / _STIFF_LAG_S), _STIFF_FORCE
        self._gains, self._forces = [gain] * len(_ARM), [strength * force for force in _ARM_FORCES]
        self._fresh = self._bullet.saveState()
        self.reset(np.array([*self._start_m()[:2], self.world.rest_height_m]))

    # --- as a robot --------------------------------------------------------------------------------------------------

    def now_s(self) -> float:
        """Read the engine's clock, which only ``wait_until`` moves."""
        return self._num_steps * _PHYSICS_STEP_S

    def read(self) -> RobotState:
        """Measure the arm as it is now."""
        hand = self._bullet.getLinkState(self._robot, _HAND, computeForwardKinematics=True)
        rotation = np.array(self._bullet.getMatrixFromQuaternion(hand[5])).reshape(3, 3)
        fingers = [state[0] for state in self._bullet.getJointStates(self._robot, _FINGERS)]
        return RobotState(self.now_s(), hand[4] + _TIP_M * rotation[:, 2], np.array(fingers))

    def command(self, command: Command) -> None:
        """Take a new set-point; after ``stop``, refuse until ``reset``.

        Raises:
            RobotError: it was stopped.
        """
        if self._stopped:
            raise RobotError("robot pybullet: it was stopped, and takes no commands until its next start")
        self._target = np.array(self._solve(command.effector_m))
        width_m = 0.0 if self.world.gripper == "blocked" else float(np.clip(command.width_m, 0.0, 2 * _STROKE_M))
        self._bullet.setJointMotorControlArray(
            self._robot,
            _FINGERS,
            self._bullet.POSITION_CONTROL,
            targetPositions=[width_m / 2] * 2,
            forces=[min(command.grip_force_n, _MAX_FINGER_FORCE_N)] * 2,
        )

    def wait_until(self, time_s: float) -> None:
        """Step the physics until the clock is there."""
        if self._stopped and not self._held:
            self._hold()
            self._held = True
        while self.now_s() < time_s - _EARLY_S:
            self._set_point += self._follow * (self._target - self._set_point)
            self._move_arm()
            self._bullet.stepSimulation()
            self._num_steps += 1
            self.num_touching_steps += bool(self._bullet.getContactPoints(bodyA=self._robot))

    def stop(self) -> None:
        """Hold the arm where it is, and let the fingers keep what they hold; another thread may call this, too."""
        self._stopped = True  # the engine takes one thread: the next ``wait_until``, before which no time passes, holds

    def close(self) -> None:
        """End the engine."""
        if self._bullet.isConnected():
            self._bullet.disconnect()

    # --- as a simulator ----------------------------------------------------------------------------------------------

    def reset(self, object_m: StateArray) -> None:
        """Put the arm at home, the gripper open, and the object on the table at a (3,) place; time goes on."""
        self._stopped = self._held = False
        self._bullet.restoreState(self._fresh)
        self._set_joints(self._home)
        for finger in _FINGERS:
            self._bullet.resetJointState(self._robot, finger, 0.0 if self.world.gripper == "blocked" else _STROKE_M)
        place = (*np.asarray(object_m[:2]).tolist(), self.world.rest_height_m)
        self._bullet.resetBasePositionAndOrientation(self._object, place, (0, 0, 0, 1))
        self._bullet.resetBaseVelocity(self._object, (0, 0, 0), (0, 0, 0))
        self.command(Command(np.array(self._start_m()), 2 * _STROKE_M))
        self._hold()

    def object_position(self) -> StateArray:
        """(3,) the object's centre, metres."""
        return np.array(self._bullet.getBasePositionAndOrientation(self._object)[0])

    # --- parts -------------------------------------------------------------------------------------------------------

    def _build(self) -> None:
        bullet, world = self._bullet, self.world
        bullet.setTimeStep(_PHYSICS_STEP_S)
        bullet.setGravity(0.0, 0.0, -9.81)
        self._robot = bullet.loadURDF("franka_panda/panda.urdf", basePosition=_BASE_M, useFixedBase=True)
        own, theirs = (
            (world.friction, world.pad_friction, 1.0),
            (_SURFACE_FRICTION, _FINGER_FRICTION, _SURFACE_FRICTION),
        )
        cube, pads, surface = theirs if self.parameters.cube == "panda-gym" else own
        for finger in _FINGERS:
            bullet.changeDynamics(self._robot, finger, lateralFriction=pads, spinningFriction=_FINGER_SPIN)
        # The fingers are coupled by a gear, as a Franka hand's are by a belt; in panda-gym each moves alone.
        gear = bullet.createConstraint(
            self._robot, _FINGERS[0], self._robot, _FINGERS[1], bullet.JOINT_GEAR, (1, 0, 0), (0, 0, 0), (0, 0, 0)
        )
        bullet.changeConstraint(gear, gearRatio=-1.0, erp=0.1, maxForce=_MAX_FINGER_FORCE_N)
        length, width, height = _TABLE_SIZE_M
        self._add_box((length / 2, width / 2, height / 2), (_TABLE_X_M, 0.0, -height / 2), surface)
        if world.fixture == "wall":
            from service.envs.scene import WALL_HEIGHT_M, WALL_THICKNESS_M

            area = world.workspace
            half = (WALL_THICKNESS_M / 2, area.length_y_m / 2, WALL_HEIGHT_M / 2)
            self._add_box(half, (area.center_x_m, area.center_y_m, half[2]), surface)
        edge = world.rest_height_m
        self._object = self._add_box(
            (edge, edge, edge),
            (0.0, 0.0, edge),
            cube,
            mass_kg=world.object_mass_kg,
        )

    def _add_box(
        self, half_m: Sequence[float], position_m: Sequence[float], friction: float, mass_kg: float = 0.0
    ) -> int:
        shape = self._bullet.createCollisionShape(self._bullet.GEOM_BOX, halfExtents=half_m)
        body: int = self._bullet.createMultiBody(
            baseMass=mass_kg, baseCollisionShapeIndex=shape, basePosition=position_m
        )
        self._bullet.changeDynamics(body, -1, lateralFriction=friction)
        return body

    def _start_m(self) -> tuple[float, float, float]:
        area = self.world.workspace
        return area.center_x_m, area.center_y_m, self.world.start_height_m

    def _set_joints(self, values: Sequence[float]) -> None:
        for joint, value in zip(_ARM, values, strict=True):
            self._bullet.resetJointState(self._robot, joint, value)

    def _solve(self, effector_m: Sequence[float] | StateArray) -> list[float]:
        """Joints that bring the effector there, pointing down, by PyBullet's solver, which starts where the arm is."""
        x, y, z = (float(value) for value in effector_m)
        solution: Sequence[float] = self._bullet.calculateInverseKinematics(
            self._robot,
            _GRASP_TARGET,
            (x, y, z - (_GRASP_TARGET_M - _TIP_M)),
            _DOWN,
            maxNumIterations=_MAX_ITERATIONS,
            residualThreshold=_RESIDUAL,
        )
        return list(solution[: len(_ARM)])

    def _hold(self) -> None:
        self._target = np.array([state[0] for state in self._bullet.getJointStates(self._robot, _ARM)])
        self._set_point = self._target.copy()
        self._move_arm()

    def _move_arm(self) -> None:
        self._bullet.setJointMotorControlArray(
            self._robot,
            _ARM,
            self._bullet.POSITION_CONTROL,
            targetPositions=self._set_point.tolist(),
            forces=self._forces,
            positionGains=self._gains,
        )


def connect(world: WorldConfig, parameters: Mapping[str, Any]) -> Backend:
    """Make the back-end ``pybullet``.

    Raises:
        TandemError: PyBullet is not installed, unknown parameters, or a world that it cannot show.
    """
    robot = PyBulletRobot(world, PyBulletParameters.model_validate(parameters))
    return Backend(robot, ExactPoses(robot, robot), robot)


def lag_s(response: float) -> float:
    """Time constant of the lag before stiff motors with which both together have gone that share of a step, seconds.

    The step response of two lags in series is 1 - (a exp(-t/a) - b exp(-t/b)) / (a - b).
    """
    low, high, fast = 0.01 * _STIFF_LAG_S, 100.0 * CONTROL_STEP_S, _STIFF_LAG_S
    for _ in range(60):
        slow = math.sqrt(low * high)
        left = (slow * math.exp(-CONTROL_STEP_S / slow) - fast * math.exp(-CONTROL_STEP_S / fast)) / (slow - fast)
        low, high = (slow, high) if 1.0 - left > response else (low, slow)
    return slow


def world_of(world: WorldConfig, parameters: PyBulletParameters) -> WorldConfig:
    """The world that the back-end shows: the given one, with panda-gym's cube where the configuration says so.

    Raises:
        ConfigError: not the Panda, no cube, a fixture other than the wall, or obstacles.
    """
    if parameters.cube == "panda-gym":
        world = WorldConfig.model_validate({**world.model_dump(), **PANDA_GYM_CUBE})
    if world.robot != "panda":
        raise ConfigError(f"world.robot = {world.robot.name!r}: PyBullet has the built-in panda only")
    if world.object != "cube" or world.objects:
        raise ConfigError("world.object, world.objects: PyBullet has one cube only; play a policy of one")
    if world.fixture == "box" or world.fixtures:
        raise ConfigError("world.fixture, world.fixtures: PyBullet has no fixture or the wall; choose none or wall")
    if world.obstacles:
        raise ConfigError("world.obstacles: PyBullet has the object alone; play a policy that was trained without")
    return world
