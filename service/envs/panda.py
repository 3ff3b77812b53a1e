"""The Franka Emika Panda with its parallel gripper, built in code from published numbers.

Kinematics, joint limits, torque limits: Franka documentation (modified DH parameters). Link masses and inertias:
identified by Gaz et al. 2019, as used by franka_ros. Position gains follow the MuJoCo Menagerie model, whose damping
is halved here so that a full action moves the end effector about 3 cm in one 40 ms step. The geometry is our own:
primitive shapes for collision on the gripper only (a gripper that points down keeps the arm off the table).
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from service.config.robot import EffectorConfig, FingerConfig, RobotConfig
from service.envs.objects import GRIPPER_BIT, grip, slide

JOINT_LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
JOINT_UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
FINGER_STROKE_M = 0.04
"""Travel of one finger; the opening width is twice this."""
PANDA = RobotConfig(
    name="panda",
    base_position_m=(-0.6, 0.0, 0.0),
    joints=tuple(f"joint{number}" for number in range(1, 8)),
    effector=EffectorConfig(frame="hand", position_m=(0.0, 0.0, 0.1034)),
    fingers=tuple(
        FingerConfig(joint=f"{side}_finger", closed=0.0, open=FINGER_STROKE_M, side=side) for side in ("left", "right")
    ),
    opening_m=2 * FINGER_STROKE_M,
    home=(0.0, 0.41, 0.0, -1.85, 0.0, 2.26, np.pi / 4),  # panda-gym's neutral pose
    stiffness=(4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0),
    damping=(225.0, 225.0, 175.0, 175.0, 100.0, 100.0, 100.0),
    max_force=(87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
)
"""The description of it, which is built in."""

_ARMATURE = 0.1
_JOINT_DAMPING = 1.0
_FINGER_ARMATURE = 0.3

# Link frames in their parents: position, unnormalised quaternion wxyz.
_FRAMES: tuple[tuple[tuple[float, float, float], tuple[float, float, float, float]], ...] = (
    ((0.0, 0.0, 0.333), (1, 0, 0, 0)),
    ((0.0, 0.0, 0.0), (1, -1, 0, 0)),
    ((0.0, -0.316, 0.0), (1, 1, 0, 0)),
    ((0.0825, 0.0, 0.0), (1, 1, 0, 0)),
    ((-0.0825, 0.384, 0.0), (1, -1, 0, 0)),
    ((0.0, 0.0, 0.0), (1, 1, 0, 0)),
    ((0.088, 0.0, 0.0), (1, 1, 0, 0)),
)
# Mass kg, centre of mass m, inertia xx yy zz xy xz yz kg m2 (Gaz et al. 2019).
_INERTIALS = (
    (4.970684, (0.003875, 0.002081, -0.04762), (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169)),
    (0.646926, (-0.003141, -0.02872, 0.003495), (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704)),
    (3.228604, (0.027518, 0.039252, -0.066502), (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805)),
    (3.587895, (-0.05317, 0.104419, 0.027454), (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641)),
    (1.225946, (-0.011953, 0.041065, -0.038437), (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229)),
    (1.666555, (0.060149, -0.014117, -0.010517), (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341)),
    (0.735522, (0.010517, -0.004252, 0.061597), (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741)),
)
_HAND_QUATERNION = (0.9238795, 0.0, 0.0, -0.3826834)

_PAD_RADIUS = 0.006
_STOP_SOLIMP = (0.99, 0.9999, 0.001, 0.5, 2.0)


def add_panda(spec: mujoco.MjSpec, *, pad_friction: float, physics_step_s: float) -> None:
    """Add the arm and its collision shapes to a model under construction; ``robot.add_robot`` adds its servos.

    Args:
        spec: the model under construction.
        pad_friction: sliding friction of the fingertips.
        physics_step_s: time step; the fingers' end stops are as stiff as it allows.
    """
    body = spec.worldbody.add_body(name="link0", pos=PANDA.base_position_m)
    for index, ((position, quaternion), (mass, centre, inertia)) in enumerate(
        zip(_FRAMES, _INERTIALS, strict=True), start=1
    ):
        body = body.add_body(
            name=f"link{index}",
            pos=position,
            quat=quaternion,
            mass=mass,
            ipos=centre,
            fullinertia=inertia,
            explicitinertial=True,
        )
        body.add_joint(
            name=f"joint{index}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=(0, 0, 1),
            range=(JOINT_LOWER[index - 1], JOINT_UPPER[index - 1]),
            limited=True,
            solref_limit=(2 * physics_step_s, 1.0),
            solimp_limit=_STOP_SOLIMP,
            armature=_ARMATURE,
            damping=(_JOINT_DAMPING, 0, 0),
        )
    hand = body.add_body(
        name="hand",
        pos=(0, 0, 0.107),
        quat=_HAND_QUATERNION,
        mass=0.73,
        ipos=(-0.01, 0, 0.03),
        inertia=(0.001, 0.0025, 0.0017),
        explicitinertial=True,
    )
    _collision(hand, "hand", 0.038, ((0, -0.062, 0.03), (0, 0.062, 0.03)))
    for side, quaternion in (("left", (1, 0, 0, 0)), ("right", (0, 0, 0, 1))):
        _add_finger(hand, side, quaternion, pad_friction, physics_step_s)


def _add_finger(
    hand: Any, side: str, quaternion: tuple[float, ...], pad_friction: float, physics_step_s: float
) -> None:
    finger = hand.add_body(
        name=f"{side}_finger",
        pos=(0, 0, 0.0584),
        quat=quaternion,
        mass=0.015,
        ipos=(0, 0.01, 0.03),
        inertia=(2.375e-6, 2.375e-6, 7.5e-7),
        explicitinertial=True,
    )
    finger.add_joint(
        name=f"{side}_finger",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=(0, 1, 0),
        range=(0.0, FINGER_STROKE_M),
        limited=True,
        armature=_FINGER_ARMATURE,
        # The arm can lean on a finger with more than 100 N: a default end stop gave way by 22 mm, this one by 1 (2 ms).
        solref_limit=(2 * physics_step_s, 1.0),
        solimp_limit=_STOP_SOLIMP,
    )
    _collision(finger, f"{side}_shaft", 0.009, ((0, 0.013, 0.009), (0, 0.011, 0.043)))
    # Two upright capsules touch a cube's face in four points that span the pad: fewer and cheaper contacts than box on
    # box at the same grip. (One line of contact is not enough: a cube rolls out between two lines nearer than its own
    # width.) Their inner surface is the pad plane y = 0; they end 7 mm below the end effector.
    for end, x in (("front", 0.0075), ("back", -0.0075)):
        pad = _collision(finger, f"{side}_pad_{end}", _PAD_RADIUS, ((x, _PAD_RADIUS, 0.034), (x, _PAD_RADIUS, 0.046)))
        grip(pad, pad_friction)


def _collision(body: Any, name: str, radius: float, ends: tuple[tuple[float, ...], ...]) -> Any:
    geom = body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=(radius, 0, 0),
        fromto=[*ends[0], *ends[1]],
        contype=GRIPPER_BIT,
        conaffinity=0,
        mass=0.0,
        group=3,
    )
    slide(geom)
    return geom
