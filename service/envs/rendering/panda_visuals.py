"""Visual geometry of the Panda: white covers, dark rings where one link turns on the next, grey caps on the joints.

Each part is the convex hull of spheres, rounded discs or bevelled boxes, in metres, in the link frames of ``panda``.
They follow the robot's outline closely enough for a picture; physics does not use them.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from service.base.types import StateArray

Vector = tuple[float, float, float]

MATERIALS: dict[str, dict[str, Any]] = {
    "cover": {"rgba": (0.90, 0.91, 0.92, 1.0), "specular": 0.35, "shininess": 0.55},
    "joint": {"rgba": (0.17, 0.18, 0.20, 1.0), "specular": 0.3, "shininess": 0.4},
    "cap": {"rgba": (0.70, 0.72, 0.74, 1.0), "specular": 0.3, "shininess": 0.4},
    "steel": {"rgba": (0.50, 0.52, 0.55, 1.0), "specular": 0.6, "shininess": 0.7},
    "rubber": {"rgba": (0.09, 0.09, 0.10, 1.0), "specular": 0.05, "shininess": 0.1},
}
"""Materials by name, with the arguments of ``MjSpec.add_material``."""

_Y, _Z = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_CORNERS = np.array([np.where(pick, 1.0, -1.0) for pick in np.ndindex(2, 2, 2)])
_AROUND = np.linspace(0.0, 2 * np.pi, 32, endpoint=False)
_POLAR = np.linspace(0.0, np.pi, 9)


def add_panda_visuals(spec: mujoco.MjSpec) -> None:
    """Add the visual geometry to the links of ``panda.add_panda``."""
    for name, properties in MATERIALS.items():
        spec.add_material(name=name, **properties)
    _add_lower_arm(spec)
    _add_upper_arm(spec)
    _add_wrist(spec)
    _add_gripper(spec)


def make_visual(geom: Any, material: str, *, casts_shadow: bool = True) -> None:
    """Make a geom one that is only drawn: it touches nothing and weighs nothing."""
    geom.material = material
    geom.contype = geom.conaffinity = 0
    geom.mass = 0.0
    geom.group = 1
    geom.castshadow = casts_shadow


def _add_lower_arm(spec: mujoco.MjSpec) -> None:
    """Add the base to the shoulder."""
    _hull(spec, "link0", "cover", _disc((0, 0, 0.03), _Z, 0.075, 0.03), _disc((-0.10, 0, 0.025), _Z, 0.062, 0.025))
    _hull(spec, "link0", "cover", _disc((0, 0, 0.04), _Z, 0.070, 0.03), _disc((0, 0, 0.125), _Z, 0.056, 0.012))
    _hull(spec, "link0", "joint", _disc((0, 0, 0.139), _Z, 0.0545, 0.006, 0.002))
    _hull(spec, "link1", "cover", _disc((0, 0, -0.175), _Z, 0.056, 0.012), _disc((0, 0, -0.07), _Z, 0.056, 0.012))
    _hull(spec, "link1", "cover", _disc((0, 0, -0.09), _Z, 0.056, 0.012), _disc((0, 0, 0), _Y, 0.057, 0.052, 0.014))
    for side in (-1, 1):
        _hull(spec, "link1", "joint", _disc((0, side * 0.054, 0), _Y, 0.0545, 0.006, 0.002))
        _hull(spec, "link2", "cover", _disc((0, 0, side * 0.074), _Z, 0.057, 0.016, 0.010))
        _hull(spec, "link2", "cap", _disc((0, 0, side * 0.0895), _Z, 0.041, 0.002, 0.001))


def _add_upper_arm(spec: mujoco.MjSpec) -> None:
    """Add the shoulder to the forearm's ring."""
    _hull(spec, "link2", "cover", _disc((0, -0.03, 0), _Z, 0.052, 0.085, 0.03), _disc((0, -0.17, 0), _Y, 0.056, 0.014))
    _hull(spec, "link2", "joint", _disc((0, -0.189, 0), _Y, 0.0545, 0.006, 0.002))
    _hull(spec, "link3", "cover", _disc((0, 0, -0.105), _Z, 0.056, 0.014), _disc((0.078, 0, 0), _Y, 0.053, 0.05, 0.02))
    for side in (-1, 1):
        _hull(spec, "link3", "joint", _disc((0.0825, side * 0.052, 0), _Y, 0.0525, 0.006, 0.002))
        _hull(spec, "link4", "cover", _disc((0, 0, side * 0.070), _Z, 0.055, 0.014, 0.010))
        _hull(spec, "link4", "cap", _disc((0, 0, side * 0.0835), _Z, 0.039, 0.002, 0.001))
    elbow, ring = _disc((0, 0.01, 0), _Z, 0.050, 0.080, 0.03), _disc((-0.0825, 0.105, 0), _Y, 0.055, 0.014)
    _hull(spec, "link4", "cover", elbow, ring)
    _hull(spec, "link4", "joint", _disc((-0.0825, 0.124, 0), _Y, 0.0535, 0.006, 0.002))


def _add_wrist(spec: mujoco.MjSpec) -> None:
    """Add the forearm, which narrows and bends to the side of the wrist, to the flange."""
    waist, knuckle = _sphere((0, 0.035, -0.13), 0.043), _disc((0.05, 0, 0), _Z, 0.044, 0.040, 0.012)
    _hull(spec, "link5", "cover", _disc((0, 0, -0.24), _Z, 0.055, 0.014), waist)
    _hull(spec, "link5", "cover", waist, _disc((0, 0.066, 0), _Y, 0.045, 0.02, 0.012))
    _hull(spec, "link5", "cap", _disc((0, 0.0855, 0), _Y, 0.033, 0.002, 0.001))
    _hull(spec, "link6", "joint", _disc((0, 0, -0.043), _Z, 0.0435, 0.006, 0.002))
    _hull(spec, "link6", "cover", _disc((0, 0, 0), _Z, 0.046, 0.042, 0.012), knuckle)
    _hull(spec, "link6", "cover", knuckle, _disc((0.088, 0, 0), _Y, 0.046, 0.052, 0.014))
    _hull(spec, "link7", "joint", _disc((0, 0, 0.057), _Z, 0.0445, 0.006, 0.002))
    _hull(spec, "link7", "cover", _disc((0, 0, 0.078), _Z, 0.045, 0.018))
    _hull(spec, "link7", "steel", _disc((0, 0, 0.101), _Z, 0.0315, 0.006, 0.002))


def _add_gripper(spec: mujoco.MjSpec) -> None:
    bottom = [_sphere((x, y, 0.022), 0.010) for x in (-0.022, 0.022) for y in (-0.092, 0.092)]
    top = [_sphere((x, y, 0.052), 0.010) for x in (-0.020, 0.020) for y in (-0.090, 0.090)]
    foot = [_sphere((x, y, 0.022), 0.010) for x in (-0.022, 0.022) for y in (-0.05, 0.05)]
    _hull(spec, "hand", "cover", *bottom, *top)
    _hull(spec, "hand", "cover", _disc((0, 0, 0.006), _Z, 0.034, 0.006, 0.003), *foot)
    _hull(spec, "hand", "joint", _box((-0.016, -0.098, 0.058), (0.016, 0.098, 0.0655), 0.002))
    for finger in ("left_finger", "right_finger"):
        knuckle = _box((-0.0105, 0.006, 0.018), (0.0105, 0.026, 0.022), 0.002)
        tip = _box((-0.0095, 0.003, 0.046), (0.0095, 0.013, 0.0515), 0.002)
        _hull(spec, finger, "steel", _box((-0.0105, 0.004, 0.006), (0.0105, 0.027, 0.022), 0.002))
        _hull(spec, finger, "steel", knuckle, tip)
        _hull(spec, finger, "rubber", _box((-0.0095, 0.0002, 0.032), (0.0095, 0.005, 0.0518), 0.001))


def _hull(spec: mujoco.MjSpec, body: str, material: str, *clouds: StateArray) -> None:
    """Add the convex hull of point clouds to a body."""
    name = f"visual{len(spec.meshes)}"
    spec.add_mesh(name=name, uservert=np.concatenate(clouds).ravel())
    make_visual(spec.body(body).add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name), material)


def _sphere(center: Vector, radius: float) -> StateArray:
    polar, around = np.meshgrid(_POLAR, _AROUND, indexing="ij")
    unit = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
    return np.asarray(center) + radius * unit.reshape(-1, 3)


def _disc(center: Vector, axis: Vector, radius: float, half_length: float, rounding: float = 0.008) -> StateArray:
    """Points of a flat cylinder with rounded rims."""
    along, side = np.asarray(axis), np.roll(axis, 1)
    rim = np.cos(_AROUND)[:, None] * side + np.sin(_AROUND)[:, None] * np.cross(along, side)
    rings = []
    for angle in np.linspace(0.0, np.pi / 2, 3):
        ring = np.asarray(center) + (radius - rounding * (1 - np.cos(angle))) * rim
        height = (half_length - rounding * (1 - np.sin(angle))) * along
        rings += [ring + height, ring - height]
    return np.concatenate(rings)


def _box(lower: Vector, upper: Vector, bevel: float) -> StateArray:
    """Points of a box with bevelled edges."""
    center, half = np.add(lower, upper) / 2, np.subtract(upper, lower) / 2
    return np.concatenate([center + _CORNERS * (half - bevel * (1 - np.eye(3)[axis])) for axis in range(3)])
