"""The look of the Panda: white shells, dark rings where one link turns on the next, grey caps on the cross joints.

Each shell is the convex hull of balls, rounded drums or bevelled blocks, in metres, in the link frames of ``panda``.
They follow the robot's outline closely enough for the eye; physics never sees them.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Vector = tuple[float, float, float]

MATERIALS: dict[str, dict[str, Any]] = {
    "shell": {"rgba": (0.90, 0.91, 0.92, 1.0), "specular": 0.35, "shininess": 0.55},
    "joint": {"rgba": (0.17, 0.18, 0.20, 1.0), "specular": 0.3, "shininess": 0.4},
    "cap": {"rgba": (0.70, 0.72, 0.74, 1.0), "specular": 0.3, "shininess": 0.4},
    "steel": {"rgba": (0.50, 0.52, 0.55, 1.0), "specular": 0.6, "shininess": 0.7},
    "rubber": {"rgba": (0.09, 0.09, 0.10, 1.0), "specular": 0.05, "shininess": 0.1},
}
"""By name, as ``MjSpec.add_material`` takes them."""

_Y, _Z = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_CORNERS = np.array([np.where(pick, 1.0, -1.0) for pick in np.ndindex(2, 2, 2)])
_AROUND = np.linspace(0.0, 2 * np.pi, 32, endpoint=False)
_POLAR = np.linspace(0.0, np.pi, 9)


def add_shells(spec: mujoco.MjSpec) -> None:
    """Dress the links of ``panda.add_panda``."""
    for name, look in MATERIALS.items():
        spec.add_material(name=name, **look)
    _dress_lower_arm(spec)
    _dress_upper_arm(spec)
    _dress_wrist(spec)
    _dress_gripper(spec)


def only_seen(geom: Any, material: str, *, casts_shadow: bool = True) -> None:
    """Make a geom something that touches nothing and weighs nothing."""
    geom.material = material
    geom.contype = geom.conaffinity = 0
    geom.mass = 0.0
    geom.group = 1
    geom.castshadow = casts_shadow


def _dress_lower_arm(spec: mujoco.MjSpec) -> None:
    """The base to the shoulder."""
    _shell(spec, "link0", "shell", _drum((0, 0, 0.03), _Z, 0.075, 0.03), _drum((-0.10, 0, 0.025), _Z, 0.062, 0.025))
    _shell(spec, "link0", "shell", _drum((0, 0, 0.04), _Z, 0.070, 0.03), _drum((0, 0, 0.125), _Z, 0.056, 0.012))
    _shell(spec, "link0", "joint", _drum((0, 0, 0.139), _Z, 0.0545, 0.006, 0.002))
    _shell(spec, "link1", "shell", _drum((0, 0, -0.175), _Z, 0.056, 0.012), _drum((0, 0, -0.07), _Z, 0.056, 0.012))
    _shell(spec, "link1", "shell", _drum((0, 0, -0.09), _Z, 0.056, 0.012), _drum((0, 0, 0), _Y, 0.057, 0.052, 0.014))
    for side in (-1, 1):
        _shell(spec, "link1", "joint", _drum((0, side * 0.054, 0), _Y, 0.0545, 0.006, 0.002))
        _shell(spec, "link2", "shell", _drum((0, 0, side * 0.074), _Z, 0.057, 0.016, 0.010))
        _shell(spec, "link2", "cap", _drum((0, 0, side * 0.0895), _Z, 0.041, 0.002, 0.001))


def _dress_upper_arm(spec: mujoco.MjSpec) -> None:
    """The shoulder to the forearm's ring."""
    _shell(spec, "link2", "shell", _drum((0, -0.03, 0), _Z, 0.052, 0.085, 0.03), _drum((0, -0.17, 0), _Y, 0.056, 0.014))
    _shell(spec, "link2", "joint", _drum((0, -0.189, 0), _Y, 0.0545, 0.006, 0.002))
    _shell(spec, "link3", "shell", _drum((0, 0, -0.105), _Z, 0.056, 0.014), _drum((0.078, 0, 0), _Y, 0.053, 0.05, 0.02))
    for side in (-1, 1):
        _shell(spec, "link3", "joint", _drum((0.0825, side * 0.052, 0), _Y, 0.0525, 0.006, 0.002))
        _shell(spec, "link4", "shell", _drum((0, 0, side * 0.070), _Z, 0.055, 0.014, 0.010))
        _shell(spec, "link4", "cap", _drum((0, 0, side * 0.0835), _Z, 0.039, 0.002, 0.001))
    elbow, ring = _drum((0, 0.01, 0), _Z, 0.050, 0.080, 0.03), _drum((-0.0825, 0.105, 0), _Y, 0.055, 0.014)
    _shell(spec, "link4", "shell", elbow, ring)
    _shell(spec, "link4", "joint", _drum((-0.0825, 0.124, 0), _Y, 0.0535, 0.006, 0.002))


def _dress_wrist(spec: mujoco.MjSpec) -> None:
    """The forearm, which narrows and swerves to the side of the wrist, to the flange."""
    waist, knuckle = _ball((0, 0.035, -0.13), 0.043), _drum((0.05, 0, 0), _Z, 0.044, 0.040, 0.012)
    _shell(spec, "link5", "shell", _drum((0, 0, -0.24), _Z, 0.055, 0.014), waist)
    _shell(spec, "link5", "shell", waist, _drum((0, 0.066, 0), _Y, 0.045, 0.02, 0.012))
    _shell(spec, "link5", "cap", _drum((0, 0.0855, 0), _Y, 0.033, 0.002, 0.001))
    _shell(spec, "link6", "joint", _drum((0, 0, -0.043), _Z, 0.0435, 0.006, 0.002))
    _shell(spec, "link6", "shell", _drum((0, 0, 0), _Z, 0.046, 0.042, 0.012), knuckle)
    _shell(spec, "link6", "shell", knuckle, _drum((0.088, 0, 0), _Y, 0.046, 0.052, 0.014))
    _shell(spec, "link7", "joint", _drum((0, 0, 0.057), _Z, 0.0445, 0.006, 0.002))
    _shell(spec, "link7", "shell", _drum((0, 0, 0.078), _Z, 0.045, 0.018))
    _shell(spec, "link7", "steel", _drum((0, 0, 0.101), _Z, 0.0315, 0.006, 0.002))


def _dress_gripper(spec: mujoco.MjSpec) -> None:
    bottom = [_ball((x, y, 0.022), 0.010) for x in (-0.022, 0.022) for y in (-0.092, 0.092)]
    top = [_ball((x, y, 0.052), 0.010) for x in (-0.020, 0.020) for y in (-0.090, 0.090)]
    foot = [_ball((x, y, 0.022), 0.010) for x in (-0.022, 0.022) for y in (-0.05, 0.05)]
    _shell(spec, "hand", "shell", *bottom, *top)
    _shell(spec, "hand", "shell", _drum((0, 0, 0.006), _Z, 0.034, 0.006, 0.003), *foot)
    _shell(spec, "hand", "joint", _block((-0.016, -0.098, 0.058), (0.016, 0.098, 0.0655), 0.002))
    for finger in ("left_finger", "right_finger"):
        knuckle = _block((-0.0105, 0.006, 0.018), (0.0105, 0.026, 0.022), 0.002)
        tip = _block((-0.0095, 0.003, 0.046), (0.0095, 0.013, 0.0515), 0.002)
        _shell(spec, finger, "steel", _block((-0.0105, 0.004, 0.006), (0.0105, 0.027, 0.022), 0.002))
        _shell(spec, finger, "steel", knuckle, tip)
        _shell(spec, finger, "rubber", _block((-0.0095, 0.0002, 0.032), (0.0095, 0.005, 0.0518), 0.001))


def _shell(spec: mujoco.MjSpec, body: str, material: str, *clouds: Points) -> None:
    """Add the convex hull of point clouds to a body."""
    name = f"shell{len(spec.meshes)}"
    spec.add_mesh(name=name, uservert=np.concatenate(clouds).ravel())
    only_seen(spec.body(body).add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name), material)


def _ball(center: Vector, radius: float) -> Points:
    polar, around = np.meshgrid(_POLAR, _AROUND, indexing="ij")
    unit = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
    return np.asarray(center) + radius * unit.reshape(-1, 3)


def _drum(center: Vector, axis: Vector, radius: float, half_length: float, rounding: float = 0.008) -> Points:
    """A cylinder with rounded rims."""
    along, side = np.asarray(axis), np.roll(axis, 1)
    rim = np.cos(_AROUND)[:, None] * side + np.sin(_AROUND)[:, None] * np.cross(along, side)
    rings = []
    for angle in np.linspace(0.0, np.pi / 2, 3):
        ring = np.asarray(center) + (radius - rounding * (1 - np.cos(angle))) * rim
        height = (half_length - rounding * (1 - np.sin(angle))) * along
        rings += [ring + height, ring - height]
    return np.concatenate(rings)


def _block(lower: Vector, upper: Vector, bevel: float) -> Points:
    """A box with bevelled edges."""
    center, half = np.add(lower, upper) / 2, np.subtract(upper, lower) / 2
    return np.concatenate([center + _CORNERS * (half - bevel * (1 - np.eye(3)[axis])) for axis in range(3)])
