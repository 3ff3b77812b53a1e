"""The scene: a robot at a table with rigid objects, obstacles, and a fixture where a task wants one.

A fixture, a wall across the workspace or an open box, cannot be moved. The wall is part of the table; the box is
elsewhere in every world, so its place is part of a world's state. Both are touched by the object, the hand and the
fingers; the arm's links collide with nothing, and a gripper that points down keeps them far above (its flange is at
least 21 cm up). Sizes and where objects and goals are drawn: docs/decisions/0007.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from service.base.errors import ConfigError
from service.config import WorldConfig
from service.envs.objects import GRIPPER_BIT, OBJECT_BIT, STIFF, TABLE_BIT, add_things, object_names, parts_of
from service.envs.observations import ACTION
from service.envs.robot import add_robot, described
from service.envs.state_layout import OBSTACLE_PREFIX, StateLayout

TABLE_CENTER_X_M = -0.3
TABLE_HALF_SIZE_M = (0.55, 0.45, 0.2)
WALL_THICKNESS_M = 0.01
WALL_HEIGHT_M = 0.07
"""Higher than the cube, and so low that the hand does not touch it while the fingers hold a cube beside it."""
AREA_LENGTH_M = 0.15
"""Extent of each area beside the wall, away from it; along it they are as wide as the workspace (paper: 15 x 35 cm)."""
BOX_SIZE_M = 0.10
BOX_HEIGHT_M = 0.05
BOX_SHELL_M = 0.005
"""Thickness of its walls and bottom; paper: 10 x 10 x 5 cm, taken as the outside."""
_SHELL_M, _HEIGHT_M, _SIDE_M = BOX_SHELL_M / 2, BOX_HEIGHT_M / 2, (BOX_SIZE_M - BOX_SHELL_M) / 2
BOX_PARTS = (
    ("bottom", (0.0, 0.0, _SHELL_M), (BOX_SIZE_M / 2, BOX_SIZE_M / 2, _SHELL_M)),
    ("near", (-_SIDE_M, 0.0, _HEIGHT_M), (_SHELL_M, BOX_SIZE_M / 2, _HEIGHT_M)),
    ("far", (_SIDE_M, 0.0, _HEIGHT_M), (_SHELL_M, BOX_SIZE_M / 2, _HEIGHT_M)),
    ("left", (0.0, -_SIDE_M, _HEIGHT_M), (BOX_SIZE_M / 2 - BOX_SHELL_M, _SHELL_M, _HEIGHT_M)),
    ("right", (0.0, _SIDE_M, _HEIGHT_M), (BOX_SIZE_M / 2 - BOX_SHELL_M, _SHELL_M, _HEIGHT_M)),
)
"""Name, middle and half size of the parts of the box, metres from the middle of its bottom; the bottom is first."""
GAP_M = 0.005
"""Least distance of a new object from wall or box."""
FINGER_GAP_M = 0.04
"""The same where a finger has to go in between: fingers open along y, and reach 3.7 cm beyond a 5 cm cube."""
FIXTURE_PREFIX = "fixture_"
"""Beginning of the names of a fixture's geoms."""


def build_spec(config: WorldConfig) -> mujoco.MjSpec:
    """Physics of the scene; ``rendering.decoration`` adds what is there for pictures only.

    Contacts are elliptic, with five sweeps of MuJoCo's noslip solver: they take the creep of soft contacts out of a
    grip at less cost than a high ``impratio`` (docs/decisions/0010).
    """
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep = config.physics_step_s
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 1.0
    option.noslip_iterations = 5
    # The arm's controller compensates gravity, and MuJoCo's compensation would cost a Jacobian for each of ten bodies
    # in every step. So nothing has weight but the object, by an actuator (``objects``).
    option.gravity = (0, 0, 0)
    option.iterations = 50
    option.ls_iterations = 50
    option.tolerance = 1e-8
    # A diverged world must show as NaN, so that it can be reported; MuJoCo's own reset would hide it.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    spec.compiler.degree = False
    spec.compiler.autolimits = False
    add_robot(spec, config)
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=TABLE_HALF_SIZE_M,
        pos=(TABLE_CENTER_X_M, 0, -TABLE_HALF_SIZE_M[2]),
        contype=TABLE_BIT,
        conaffinity=GRIPPER_BIT | OBJECT_BIT,
        friction=(config.friction, 0.005, 0.0001),
        group=3,
        **STIFF,
    )
    add_things(spec, config)
    _add_fixture(spec, config)
    _add_described_fixtures(spec, config)
    return spec


def build_model(config: WorldConfig) -> mujoco.MjModel:
    """Compile what ``build_spec`` builds.

    Raises:
        ConfigError: MuJoCo cannot; where a file of a robot's mesh is missing, for one.
    """
    spec = build_spec(config)
    try:
        return spec.compile()
    except ValueError as error:
        robot = described(config).name
        raise ConfigError(f"world with robot {robot}: MuJoCo cannot build it: {' '.join(str(error).split())}") from None


def build_layout(config: WorldConfig, *, blocked_fraction: float = 0.0) -> StateLayout:
    """Layout of the state of worlds that ``build_spec`` built.

    Args:
        config: the world.
        blocked_fraction: share of games with a blocked gripper; above 0, each world remembers whether its own is.
    """
    robot = described(config)
    num_joints, num_fingers = len(robot.joints), len(robot.fingers)
    drawn = config.randomisation
    things = object_names(config) + [f"{OBSTACLE_PREFIX}{number + 1}" for number in range(len(config.obstacles))]
    return StateLayout(
        positions={
            "joints": num_joints,
            "fingers": num_fingers,
            **{part: size for name in things for part, size in ((name, 3), (f"{name}_quaternion", 4))},
        },
        velocities={
            "joint_velocities": num_joints,
            "finger_velocities": num_fingers,
            **{f"{name}_{part}": 3 for name in things for part in ("velocity", "spin")},
        },
        measured={"contacts": 2 * config.num_objects, "commands": ACTION.size * config.num_kept_commands},
        kept={
            "box_place": 3 if config.fixture == "box" else 0,  # the middle of its bottom
            "gripper_blocked": int(blocked_fraction > 0.0),
            "model": int(bool(drawn.model_ranges)),  # its index in the bank
            "delay": int(drawn.delay_steps is not None),
            "object_offset": 3 * config.num_objects if drawn.object_offset_m is not None else 0,
            "object_noise": 2 if drawn.object_noise_m is not None else 0,  # its std and key
        },
    )


def _add_fixture(spec: mujoco.MjSpec, config: WorldConfig) -> None:
    """Add the wall, or the box's bottom and walls."""
    workspace = config.workspace
    if config.fixture == "wall":
        half = (WALL_THICKNESS_M / 2, workspace.length_y_m / 2, WALL_HEIGHT_M / 2)
        middle = (workspace.center_x_m, workspace.center_y_m, half[2])
        _add_fixed(spec.worldbody, "wall", config, type=mujoco.mjtGeom.mjGEOM_BOX, pos=middle, size=half)
    elif config.fixture == "box":
        box = spec.worldbody.add_body(name="box", pos=(workspace.center_x_m, workspace.center_y_m, 0.0), mocap=True)
        for name, middle, half in BOX_PARTS:
            _add_fixed(box, name, config, type=mujoco.mjtGeom.mjGEOM_BOX, pos=middle, size=half)


def _add_described_fixtures(spec: mujoco.MjSpec, config: WorldConfig) -> None:
    """Add those of ``world.fixtures``."""
    for number, fixture in enumerate(config.fixtures):
        x, y = fixture.position_m
        half = fixture.turn_rad / 2
        body = spec.worldbody.add_body(
            pos=(x, y, fixture.bottom_m + fixture.extent_m[2] / 2), quat=(np.cos(half), 0.0, 0.0, np.sin(half))
        )
        for index, part in enumerate(parts_of(spec, fixture, f"fixture{number}-", 1.0)):
            _add_fixed(body, f"{number}-{index}", config, rgba=(*fixture.color, 1.0), **part)


def _add_fixed(body: Any, name: str, config: WorldConfig, **shape: Any) -> None:
    """Add a geom that object and gripper touch."""
    body.add_geom(
        name=FIXTURE_PREFIX + name,
        contype=0,
        conaffinity=GRIPPER_BIT | OBJECT_BIT,
        friction=(config.friction, 0.005, 0.0001),
        group=2,
        **shape,
        **STIFF,
    )
