"""Contacts: who touches whom, how stiffly, and the sensors that say whether the fingers touch the object."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco

GRIPPER_BIT, OBJECT_BIT, TABLE_BIT, FLOOR_BIT = 1, 2, 4, 8
"""MuJoCo's contact types. Table and fixtures are touched by gripper and object, the object by the gripper. Obstacles
are objects that are also touched by objects, and by the floor."""
OBSTACLE_PRIORITY, _PAD_PRIORITY = 1, 2
"""Where two touch, friction and stiffness are those of the one with more."""
STIFF = {"solref": (0.01, 1.0), "solimp": (0.95, 0.99, 0.001, 0.5, 2.0)}
"""Contacts of objects and what they lie on. MuJoCo's default yields more the lighter the object: an arm leaning on the
cube pressed it 11 mm down. These let it give 1 mm."""
BODY_FRICTION = 0.3
"""Sliding friction of a gripper but for its fingertips."""


def grip(geom: mujoco.MjsGeom, friction: float) -> None:
    """Let a geom of a finger hold what it touches."""
    geom.friction = (friction, 0.005, 0.0001)
    geom.condim = 4  # torsion, or a cube turns between the fingers
    geom.solref, geom.solimp = (0.01, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)
    geom.priority = _PAD_PRIORITY  # these parameters, not a mixture with the object's


def add_finger_sensors(spec: mujoco.MjSpec, fingers: Iterable[str]) -> None:
    """Sensors of whether each finger, a body with all that hangs on it, touches the object: above 0 where it does."""
    for finger in fingers:
        sensor = spec.add_sensor(
            name=f"{finger}_contact",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_XBODY,
            objname=finger,
            reftype=mujoco.mjtObj.mjOBJ_BODY,
            refname="object",
        )
        sensor.intprm[:3] = (1, 0, 1)  # data bits (1: "found"), reduction (0: none), slots (1)
