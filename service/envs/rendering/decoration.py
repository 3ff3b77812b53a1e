"""Decoration of the scene for pictures: the Panda's covers, table, floor, sky, light, and the workspace's edges.

All of it is made from numbers. No part collides, weighs anything or moves by itself, so a state of the physics model is
a state of the decorated one.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from service.base.types import StateArray
from service.config import WorkspaceConfig, WorldConfig
from service.config.model_files import Vector
from service.envs.objects import FLOOR_Z_M, object_names
from service.envs.scene import FIXTURE_PREFIX, TABLE_CENTER_X_M, TABLE_HALF_SIZE_M

_TABLE_THICKNESS_M = 0.035
_TEXTURE_SIZE = 512
_MATERIALS: dict[str, dict[str, Any]] = {
    "cover": {"rgba": (0.90, 0.91, 0.92, 1.0), "specular": 0.35, "shininess": 0.55},
    "joint": {"rgba": (0.17, 0.18, 0.20, 1.0), "specular": 0.3, "shininess": 0.4},
    "cap": {"rgba": (0.70, 0.72, 0.74, 1.0), "specular": 0.3, "shininess": 0.4},
    "steel": {"rgba": (0.50, 0.52, 0.55, 1.0), "specular": 0.6, "shininess": 0.7},
    "rubber": {"rgba": (0.09, 0.09, 0.10, 1.0), "specular": 0.05, "shininess": 0.1},
    "fixture": {"rgba": (0.42, 0.47, 0.54, 1.0), "specular": 0.3, "shininess": 0.4},
    "leg": {"rgba": (0.24, 0.25, 0.27, 1.0), "specular": 0.2, "shininess": 0.3},
    "outline": {"rgba": (0.10, 0.36, 0.62, 0.85), "emission": 0.3, "specular": 0.0},
    "edge": {"rgba": (0.10, 0.36, 0.62, 0.22), "emission": 0.3, "specular": 0.0},
    "volume": {"rgba": (0.10, 0.40, 0.80, 0.05), "emission": 0.5, "specular": 0.0},
}
"""Materials by name, with the arguments of ``MjSpec.add_material``; the first five are the Panda's."""
_Y, _Z = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_CORNERS = np.array([np.where(pick, 1.0, -1.0) for pick in np.ndindex(2, 2, 2)])
_AROUND = np.linspace(0.0, 2 * np.pi, 32, endpoint=False)
_POLAR = np.linspace(0.0, np.pi, 9)


def decorate(spec: mujoco.MjSpec, config: WorldConfig) -> None:
    """Add everything that is only drawn to the physics of ``scene.build_spec``; the layout of its state stays."""
    for name, properties in _MATERIALS.items():
        spec.add_material(name=name, **properties)
    if config.robot == "panda":  # others come with what they look like
        _add_panda_visuals(spec)
    _add_table(spec)
    _add_floor_and_sky(spec)
    _add_lights(spec)
    _add_workspace(spec, config.workspace)
    for name, body in zip(object_names(config), config.bodies, strict=True):
        spec.add_material(name=name, rgba=(*body.color, 1.0), specular=0.35, shininess=0.5)
        for geom in spec.body(name).geoms:
            geom.material = name
    for geom in spec.geoms:
        if geom.name.startswith(FIXTURE_PREFIX):
            geom.material = "fixture"


def _add_table(spec: mujoco.MjSpec) -> None:
    texture = spec.add_texture(name="wood", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
    texture.width = texture.height = _TEXTURE_SIZE
    texture.data = _wood().tobytes()
    _textured(spec, "wood", specular=0.12, shininess=0.25)
    half_x, half_y, _ = TABLE_HALF_SIZE_M
    half_z, leg_half_z = _TABLE_THICKNESS_M / 2, -(FLOOR_Z_M + _TABLE_THICKNESS_M) / 2
    _box(spec, "wood", (TABLE_CENTER_X_M, 0, -half_z), (half_x, half_y, half_z))
    _box(spec, "leg", (TABLE_CENTER_X_M, 0, -_TABLE_THICKNESS_M - 0.025), (half_x - 0.05, half_y - 0.05, 0.025))
    for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        center = (TABLE_CENTER_X_M + x * (half_x - 0.06), y * (half_y - 0.06), FLOOR_Z_M + leg_half_z)
        _box(spec, "leg", center, (0.025, 0.025, leg_half_z))


def _wood() -> NDArray[np.uint8]:
    """(size, size, 3) picture of light maple: streaks along one direction that wander a little, and fine grain."""
    rng = np.random.default_rng(7)
    unit = np.linspace(0.0, 1.0, _TEXTURE_SIZE)
    along, across = np.meshgrid(unit, unit)
    wandering = across + 0.02 * np.sin(2 * np.pi * (along + 0.3)) + 0.008 * np.sin(2 * np.pi * (3 * along + across))
    shade = 0.35 * rng.normal(size=(_TEXTURE_SIZE, 1))
    for frequency, phase in zip((3, 7, 13, 29, 53, 97), rng.random(6), strict=True):
        shade = shade + np.sin(2 * np.pi * (frequency * wandering + phase)) / (1 + 0.1 * frequency)
    colour = (1.0 + 0.022 * shade[:, :, None]) * np.array([0.80, 0.70, 0.57])
    image: NDArray[np.uint8] = np.clip(255 * colour, 0, 255).astype(np.uint8)
    return image


def _add_floor_and_sky(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.93, 0.95, 0.97), rgb2=(0.62, 0.70, 0.79), width=256, height=256 * 6,
    )  # fmt: skip
    spec.add_texture(
        name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.70, 0.72, 0.74), rgb2=(0.65, 0.67, 0.69), width=256, height=256,
    )  # fmt: skip
    _textured(spec, "floor", texrepeat=(1.5, 1.5), texuniform=True, emission=0.12, specular=0.1, shininess=0.1)
    plane = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 0.05), pos=(0, 0, FLOOR_Z_M))
    _make_visual(plane, "floor", casts_shadow=False)
    visual = spec.visual
    visual.rgba.haze = (0.80, 0.84, 0.88, 1.0)
    visual.map.haze = 0.35
    visual.map.znear, visual.map.zfar = 0.02, 30.0
    visual.global_.fovy = 32.0
    spec.stat.extent = 1.3
    spec.stat.center = (-0.25, 0.0, 0.15)


def _add_lights(spec: mujoco.MjSpec) -> None:
    """Add a warm light with shadow over the viewer's shoulder, a cool one from the other side, and some ambient."""
    spec.worldbody.add_light(
        pos=(0.9, -1.5, 2.6), dir=(-1.1, 1.5, -2.6), type=mujoco.mjtLightType.mjLIGHT_SPOT, cutoff=80, exponent=1,
        diffuse=(0.56, 0.55, 0.53), specular=(0.3, 0.3, 0.3), castshadow=True,
    )  # fmt: skip
    spec.worldbody.add_light(
        dir=(-0.7, -0.8, -0.8), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, diffuse=(0.24, 0.25, 0.27),
        specular=(0.1, 0.1, 0.1), castshadow=False,
    )  # fmt: skip
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = (0.34, 0.34, 0.35), (0.16, 0.16, 0.16), (0, 0, 0)
    # The shadow map covers this share of the cone, the robot and its table: none of its pixels is spent on the floor.
    spec.visual.map.shadowscale = 0.26


def _add_workspace(spec: mujoco.MjSpec, workspace: WorkspaceConfig) -> None:
    """Add the workspace's outline on the table, its faint other edges, and a little colour inside."""
    low, high = np.array([*workspace.lower_m[:2], 0.001]), np.array(workspace.upper_m)
    corners = [np.where(pick, high, low) for pick in np.ndindex(2, 2, 2)]
    for start, end in combinations(corners, 2):
        if np.count_nonzero(start != end) > 1:
            continue  # a diagonal, not an edge
        on_table = bool(end[2] == low[2])
        size, fromto = (0.002 if on_table else 0.001, 0, 0), np.concatenate((start, end))
        line = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=size, fromto=fromto)
        _make_visual(line, "outline" if on_table else "edge", casts_shadow=False)
    _box(spec, "volume", (low + high) / 2, (high - low) / 2, casts_shadow=False)


def _textured(spec: mujoco.MjSpec, name: str, **properties: Any) -> None:
    """Add a material of the texture of the same name."""
    spec.add_material(name=name, **properties).textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _box(
    spec: mujoco.MjSpec, material: str, center: Sequence[float] | StateArray, half: Sequence[float] | StateArray,
    *, casts_shadow: bool = True,
) -> None:  # fmt: skip
    geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=center, size=half)
    _make_visual(geom, material, casts_shadow=casts_shadow)


# --- the Panda -------------------------------------------------------------------------------------------------------


def _add_panda_visuals(spec: mujoco.MjSpec) -> None:
    """Add covers, dark rings where one link turns on the next, and grey caps to the links of ``panda.add_panda``.

    Each part is the convex hull of spheres, rounded discs or bevelled boxes, in metres, in the link frames. They follow
    the robot's outline closely enough for a picture; physics does not use them.
    """
    # The base to the shoulder.
    _hull(spec, "link0", "cover", _disc((0, 0, 0.03), _Z, 0.075, 0.03), _disc((-0.10, 0, 0.025), _Z, 0.062, 0.025))
    _hull(spec, "link0", "cover", _disc((0, 0, 0.04), _Z, 0.070, 0.03), _disc((0, 0, 0.125), _Z, 0.056, 0.012))
    _hull(spec, "link0", "joint", _disc((0, 0, 0.139), _Z, 0.0545, 0.006, 0.002))
    _hull(spec, "link1", "cover", _disc((0, 0, -0.175), _Z, 0.056, 0.012), _disc((0, 0, -0.07), _Z, 0.056, 0.012))
    _hull(spec, "link1", "cover", _disc((0, 0, -0.09), _Z, 0.056, 0.012), _disc((0, 0, 0), _Y, 0.057, 0.052, 0.014))
    for side in (-1, 1):
        _hull(spec, "link1", "joint", _disc((0, side * 0.054, 0), _Y, 0.0545, 0.006, 0.002))
        _hull(spec, "link2", "cover", _disc((0, 0, side * 0.074), _Z, 0.057, 0.016, 0.010))
        _hull(spec, "link2", "cap", _disc((0, 0, side * 0.0895), _Z, 0.041, 0.002, 0.001))
    # The shoulder to the forearm's ring.
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
    # The forearm, which narrows and bends to the side of the wrist, to the flange.
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
    # The gripper.
    bottom = [_sphere((x, y, 0.022), 0.010) for x in (-0.022, 0.022) for y in (-0.092, 0.092)]
    top = [_sphere((x, y, 0.052), 0.010) for x in (-0.020, 0.020) for y in (-0.090, 0.090)]
    foot = [_sphere((x, y, 0.022), 0.010) for x in (-0.022, 0.022) for y in (-0.05, 0.05)]
    _hull(spec, "hand", "cover", *bottom, *top)
    _hull(spec, "hand", "cover", _disc((0, 0, 0.006), _Z, 0.034, 0.006, 0.003), *foot)
    _hull(spec, "hand", "joint", _bevelled((-0.016, -0.098, 0.058), (0.016, 0.098, 0.0655), 0.002))
    for finger in ("left_finger", "right_finger"):
        knuckle = _bevelled((-0.0105, 0.006, 0.018), (0.0105, 0.026, 0.022), 0.002)
        tip = _bevelled((-0.0095, 0.003, 0.046), (0.0095, 0.013, 0.0515), 0.002)
        _hull(spec, finger, "steel", _bevelled((-0.0105, 0.004, 0.006), (0.0105, 0.027, 0.022), 0.002))
        _hull(spec, finger, "steel", knuckle, tip)
        _hull(spec, finger, "rubber", _bevelled((-0.0095, 0.0002, 0.032), (0.0095, 0.005, 0.0518), 0.001))


def _make_visual(geom: Any, material: str, *, casts_shadow: bool = True) -> None:
    """Make a geom one that is only drawn: it touches nothing and weighs nothing."""
    geom.material = material
    geom.contype = geom.conaffinity = 0
    geom.mass = 0.0
    geom.group = 1
    geom.castshadow = casts_shadow


def _hull(spec: mujoco.MjSpec, body: str, material: str, *clouds: StateArray) -> None:
    """Add the convex hull of point clouds to a body."""
    name = f"visual{len(spec.meshes)}"
    spec.add_mesh(name=name, uservert=np.concatenate(clouds).ravel())
    _make_visual(spec.body(body).add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name), material)


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


def _bevelled(lower: Vector, upper: Vector, bevel: float) -> StateArray:
    """Points of a box with bevelled edges."""
    center, half = np.add(lower, upper) / 2, np.subtract(upper, lower) / 2
    return np.concatenate([center + _CORNERS * (half - bevel * (1 - np.eye(3)[axis])) for axis in range(3)])
