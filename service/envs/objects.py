"""Rigid things in a scene: what touches what, how stiffly, and the object and the obstacles that lie on the table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any

import mujoco

from service.config import WorldConfig
from service.config.model_files import MeshConfig, Vector, model_file
from service.config.objects import ROUND, ObjectConfig
from service.envs.state_layout import OBSTACLE_PREFIX

GRIPPER_BIT, OBJECT_BIT, TABLE_BIT, FLOOR_BIT = 1, 2, 4, 8
"""MuJoCo's contact types. Table and fixtures are touched by gripper and object, the object by the gripper. Obstacles
are objects that are also touched by objects, and by the floor."""
THING_PRIORITY, _GRIPPER_PRIORITY = 1, 2
"""Where two touch, friction and stiffness are those of the one with more."""
STIFF = {"solref": (0.01, 1.0), "solimp": (0.95, 0.99, 0.001, 0.5, 2.0)}
"""Contacts of objects and what they lie on. MuJoCo's default yields more the lighter the object: an arm leaning on the
cube pressed it 11 mm down. These let it give 1 mm."""
BODY_FRICTION = 0.3
"""Sliding friction of a gripper but for its fingertips."""
GRAVITY_MS2 = 9.81
FLOOR_Z_M = -0.74
_HIDDEN = 3
"""Group of what is not drawn."""
_UPRIGHT = "upright"
"""Site whose z axis is up: forces on other sites have its directions."""


def slide(geom: mujoco.MjsGeom) -> None:
    """Let a geom of the gripper slide over what it touches, as metal does: it pushes a cube, but does not wedge it."""
    geom.friction = (BODY_FRICTION, 0.005, 0.0001)
    geom.solref, geom.solimp = STIFF["solref"], STIFF["solimp"]
    geom.priority = _GRIPPER_PRIORITY


def grip(geom: mujoco.MjsGeom, friction: float) -> None:
    """Let a geom of a finger hold what it touches."""
    geom.friction = (friction, 0.005, 0.0001)
    geom.condim = 4  # torsion, or a cube turns between the fingers
    geom.solref, geom.solimp = (0.01, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)
    geom.priority = _GRIPPER_PRIORITY  # these parameters, not a mixture with the object's


def object_names(config: WorldConfig) -> list[str]:
    """Names of the bodies of the objects that have goals."""
    return ["object", *(f"object_{number}" for number in range(2, config.num_objects + 1))]


def add_finger_sensors(spec: mujoco.MjSpec, fingers: Sequence[str], objects: Iterable[str]) -> None:
    """Sensors of whether each finger, a body with all that hangs on it, touches an object: above 0 where it does.

    In the order of the objects, and of each in that of the fingers.
    """
    for name, finger in product(objects, fingers):
        sensor = spec.add_sensor(
            name=f"{finger}_contact_{name}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_XBODY,
            objname=finger,
            reftype=mujoco.mjtObj.mjOBJ_BODY,
            refname=name,
        )
        sensor.intprm[:3] = (1, 0, 1)  # data bits (1: "found"), reduction (0: none), slots (1)


def geometry(shape: ObjectConfig) -> tuple[mujoco.mjtGeom, tuple[float, float, float], tuple[float, ...]]:
    """MuJoCo's type of an object, of a mesh the box around it; its half sizes, metres; and its quaternion at first."""
    half_x, half_y, half_z = (extent / 2 for extent in shape.extent_m)
    upright, lying = (1.0, 0.0, 0.0, 0.0), (0.5**0.5, 0.0, 0.5**0.5, 0.0)
    kind = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.shape.upper()}" if shape.mesh is None else "mjGEOM_BOX")
    if shape.shape == "cylinder":
        return kind, (half_x, half_z, 0.0), upright
    if shape.shape == "capsule":  # MuJoCo's length is without the two ends
        return kind, (half_z, half_x - half_z, 0.0), lying
    return kind, (half_x, half_y, half_z), upright


def parts_of(spec: mujoco.MjSpec, shape: ObjectConfig, name: str, mass_kg: float) -> list[dict[str, Any]]:
    """Settings of the geoms that an object is made of; adds what they need to the scene.

    Raises:
        ConfigError: a file of a mesh is gone, or another than it was.
    """
    if shape.mesh is not None:
        return _add_mesh(spec, shape.mesh, name, mass_kg)
    kind, size, quaternion = geometry(shape)
    return [{"type": kind, "size": size, "quat": quaternion, "mass": mass_kg}]


def add_things(spec: mujoco.MjSpec, config: WorldConfig) -> None:
    """Add the objects that players move, and obstacles: a game goes on when one of these falls onto the floor.

    The gripper touches them, and they touch table, fixtures and each other. Where there are several things, the
    friction of each counts wherever it lies, not the greater one of it and the table's, as without a priority.
    """
    touching = {"contype": OBJECT_BIT, "conaffinity": GRIPPER_BIT}
    if config.num_objects > 1:
        touching = {"contype": OBJECT_BIT, "conaffinity": GRIPPER_BIT | OBJECT_BIT, "priority": THING_PRIORITY}
    for name, body in zip(object_names(config), config.bodies, strict=True):
        _add_free(spec, body, name, body.mass_kg, body.friction, touching)
    touching = {
        "contype": OBJECT_BIT,
        "conaffinity": GRIPPER_BIT | OBJECT_BIT | FLOOR_BIT,
        "priority": THING_PRIORITY,
    }
    for number, obstacle in enumerate(config.obstacles, start=1):
        _add_free(spec, obstacle, f"{OBSTACLE_PREFIX}{number}", obstacle.mass_kg, obstacle.friction, touching)
    if config.obstacles:
        _add_floor(spec)


def _add_floor(spec: mujoco.MjSpec) -> None:
    """Add a floor, so that what falls off the table does not fall for ever."""
    # A body of its own: the tree of bounds of the world's geoms is made once, and a model bank moves the table later.
    spec.worldbody.add_body(name="ground").add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(0, 0, 0.05),
        pos=(0, 0, FLOOR_Z_M),
        contype=FLOOR_BIT,
        conaffinity=0,
        group=_HIDDEN,
        **STIFF,
    )


def _add_free(
    spec: mujoco.MjSpec,
    shape: ObjectConfig,
    name: str,
    mass_kg: float,
    friction: float,
    touching: dict[str, int],
) -> None:
    body = spec.worldbody.add_body(name=name, pos=(0, 0, shape.extent_m[2] / 2))
    body.add_freejoint(name=name)
    for index, part in enumerate(parts_of(spec, shape, name, mass_kg)):
        body.add_geom(
            name=f"{name}{index or ''}",
            friction=(friction, 0.005, 0.0001),
            condim=6 if shape.shape in ROUND else 3,
            group=2,
            rgba=(*shape.color, 1.0),
            **touching,
            **part,
            **STIFF,
        )
    weight = spec.add_actuator(name=f"{name}_weight", gear=(0, 0, 1, 0, 0, 0), **_held_by(spec, body, shape))
    weight.gaintype, weight.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    weight.gainprm[0], weight.biasprm[0] = 0.0, -GRAVITY_MS2 * mass_kg  # whatever its control is


def _held_by(spec: mujoco.MjSpec, body: mujoco.MjsBody, shape: ObjectConfig) -> dict[str, Any]:
    """What the weight acts on: the free joint, which is at the middle, or of a mesh, its center of mass."""
    if shape.mesh is None:
        return {"target": body.name, "trntype": mujoco.mjtTrn.mjTRN_JOINT}
    if spec.site(_UPRIGHT) is None:
        spec.worldbody.add_site(name=_UPRIGHT, group=_HIDDEN)
    center = body.add_site(name=f"{body.name}_center", pos=_center_of_mass(shape.mesh), group=_HIDDEN)
    return {"target": center.name, "refsite": _UPRIGHT, "trntype": mujoco.mjtTrn.mjTRN_SITE}


def _add_mesh(spec: mujoco.MjSpec, mesh: MeshConfig, name: str, mass_kg: float) -> list[dict[str, Any]]:
    """Add the pieces of a mesh to a scene under construction; returns the settings of a geom for each.

    Raises:
        ConfigError: a file is gone, or another than it was.
    """
    parts = []
    for index, (piece, sha256) in enumerate(zip(mesh.pieces, mesh.sha256, strict=True)):
        spec.add_mesh(name=f"{name}{index}", file=str(model_file(piece, sha256)), scale=[mesh.scale] * 3)
        parts.append(
            {
                "type": mujoco.mjtGeom.mjGEOM_MESH,
                "meshname": f"{name}{index}",
                "pos": [-each for each in mesh.center_m],
                "density": mass_kg / mesh.volume_m3,
            }
        )
    return parts


def _center_of_mass(mesh: MeshConfig) -> Vector:
    """Center of mass of a mesh, as dense everywhere, from the middle of its extent, metres.

    Raises:
        ConfigError: a file is gone, or another than it was.
    """
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="mesh")
    for part in _add_mesh(spec, mesh, "piece", 1.0):
        body.add_geom(**part)
    x, y, z = map(float, spec.compile().body("mesh").ipos)
    return x, y, z
