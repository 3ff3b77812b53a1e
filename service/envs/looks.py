"""What only eyes need: a white Panda of smooth shells, a wooden table, floor, sky and light.

Everything is made here from numbers, nothing is loaded. Shells are convex hulls of balls and rounded drums, in the link
frames of ``panda``. No part collides or weighs anything, so a state of the physics model is a state of this one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from service.config import WorkspaceConfig, WorldConfig
from service.envs.scene import TABLE_CENTER_X_M, TABLE_HALF_SIZE_M

Points = NDArray[np.float64]
Vector = tuple[float, float, float]

OBJECT_RGB = (0.86, 0.13, 0.11)
_FLOOR_Z_M = -0.74
_TABLE_THICKNESS_M = 0.035
_MATERIALS: dict[str, dict[str, Any]] = {
    "shell": {"rgba": (0.90, 0.91, 0.92, 1), "specular": 0.35, "shininess": 0.55},
    "joint": {"rgba": (0.17, 0.18, 0.20, 1), "specular": 0.3, "shininess": 0.4},
    "cap": {"rgba": (0.70, 0.72, 0.74, 1), "specular": 0.3, "shininess": 0.4},
    "steel": {"rgba": (0.50, 0.52, 0.55, 1), "specular": 0.6, "shininess": 0.7},
    "rubber": {"rgba": (0.09, 0.09, 0.10, 1), "specular": 0.05, "shininess": 0.1},
    "object": {"rgba": (*OBJECT_RGB, 1), "specular": 0.35, "shininess": 0.5},
    "leg": {"rgba": (0.24, 0.25, 0.27, 1), "specular": 0.2, "shininess": 0.3},
    "outline": {"rgba": (0.10, 0.36, 0.62, 0.85), "emission": 0.3, "specular": 0.0},
    "edge": {"rgba": (0.10, 0.36, 0.62, 0.22), "emission": 0.3, "specular": 0.0},
    "volume": {"rgba": (0.30, 0.60, 0.90, 0.05), "emission": 0.5, "specular": 0.0},
}

_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def decorate(spec: mujoco.MjSpec, config: WorldConfig) -> None:
    """Add to the physics of ``scene.build_spec`` everything that makes it a picture."""
    for name, look in _MATERIALS.items():
        spec.add_material(name=name, **look)
    _add_arm(spec)
    _add_gripper(spec)
    _add_table(spec)
    _add_room(spec)
    _add_workspace(spec, config.workspace)
    spec.geom("object").material = "object"


# --- robot ---------------------------------------------------------------------------------------------------------


def _add_arm(spec: mujoco.MjSpec) -> None:
    """Shells between the joints, a dark ring where one link turns on the next, grey caps on the cross joints."""
    shell = _Sculptor(spec)
    shell("link0", "shell", _drum((0, 0, 0.03), _Z, 0.075, 0.03), _drum((-0.10, 0, 0.025), _Z, 0.062, 0.025))
    shell("link0", "shell", _drum((0, 0, 0.04), _Z, 0.070, 0.03), _drum((0, 0, 0.125), _Z, 0.056, 0.012))
    shell("link0", "joint", _drum((0, 0, 0.139), _Z, 0.0545, 0.006, 0.002))
    shell("link1", "shell", _drum((0, 0, -0.175), _Z, 0.056, 0.012), _drum((0, 0, -0.07), _Z, 0.056, 0.012))
    shell("link1", "shell", _drum((0, 0, -0.09), _Z, 0.056, 0.012), _drum((0, 0, 0), _Y, 0.057, 0.052, 0.014))
    for side in (-1, 1):
        shell("link1", "joint", _drum((0, side * 0.054, 0), _Y, 0.0545, 0.006, 0.002))
        shell("link2", "shell", _drum((0, 0, side * 0.074), _Z, 0.057, 0.016, 0.010))
        shell("link2", "cap", _drum((0, 0, side * 0.0895), _Z, 0.041, 0.002, 0.001))
    shell("link2", "shell", _drum((0, -0.03, 0), _Z, 0.052, 0.085, 0.03), _drum((0, -0.17, 0), _Y, 0.056, 0.014))
    shell("link2", "joint", _drum((0, -0.189, 0), _Y, 0.0545, 0.006, 0.002))
    shell("link3", "shell", _drum((0, 0, -0.105), _Z, 0.056, 0.014), _drum((0.078, 0, 0), _Y, 0.053, 0.05, 0.02))
    for side in (-1, 1):
        shell("link3", "joint", _drum((0.0825, side * 0.052, 0), _Y, 0.0525, 0.006, 0.002))
        shell("link4", "shell", _drum((0, 0, side * 0.070), _Z, 0.055, 0.014, 0.010))
        shell("link4", "cap", _drum((0, 0, side * 0.0835), _Z, 0.039, 0.002, 0.001))
    shell("link4", "shell", _drum((0, 0.01, 0), _Z, 0.050, 0.080, 0.03), _drum((-0.0825, 0.105, 0), _Y, 0.055, 0.014))
    shell("link4", "joint", _drum((-0.0825, 0.124, 0), _Y, 0.0535, 0.006, 0.002))
    shell("link5", "shell", _drum((0, 0, -0.24), _Z, 0.055, 0.014), _ball((0, 0.035, -0.13), 0.043))
    shell("link5", "shell", _ball((0, 0.035, -0.13), 0.043), _drum((0, 0.066, 0), _Y, 0.045, 0.02, 0.012))
    shell("link5", "cap", _drum((0, 0.0855, 0), _Y, 0.033, 0.002, 0.001))
    shell("link6", "joint", _drum((0, 0, -0.043), _Z, 0.0435, 0.006, 0.002))
    shell("link6", "shell", _drum((0, 0, 0.0), _Z, 0.046, 0.042, 0.012), _drum((0.05, 0, 0), _Z, 0.04, 0.040, 0.012))
    shell("link6", "shell", _drum((0.05, 0, 0), _Z, 0.044, 0.040, 0.012), _drum((0.088, 0, 0), _Y, 0.046, 0.052, 0.014))
    shell("link7", "joint", _drum((0, 0, 0.057), _Z, 0.0445, 0.006, 0.002))
    shell("link7", "shell", _drum((0, 0, 0.078), _Z, 0.045, 0.018, 0.008))
    shell("link7", "steel", _drum((0, 0, 0.101), _Z, 0.0315, 0.006, 0.002))


def _add_gripper(spec: mujoco.MjSpec) -> None:
    shell = _Sculptor(spec)
    low = [_ball((x, y, 0.022), 0.010) for x in (-0.022, 0.022) for y in (-0.092, 0.092)]
    high = [_ball((x, y, 0.052), 0.010) for x in (-0.020, 0.020) for y in (-0.090, 0.090)]
    neck = _drum((0, 0, 0.006), _Z, 0.034, 0.006, 0.003)
    shell("hand", "shell", *low, *high)
    shell("hand", "shell", neck, *[_ball((x, y, 0.022), 0.010) for x in (-0.022, 0.022) for y in (-0.05, 0.05)])
    shell("hand", "joint", _block((-0.016, -0.098, 0.058), (0.016, 0.098, 0.0655), 0.002))
    for side in ("left", "right"):
        finger = f"{side}_finger"
        shell(finger, "steel", _block((-0.0105, 0.004, 0.006), (0.0105, 0.027, 0.022), 0.002))
        shell(
            finger, "steel",
            _block((-0.0105, 0.006, 0.018), (0.0105, 0.026, 0.022), 0.002),
            _block((-0.0095, 0.003, 0.046), (0.0095, 0.013, 0.0515), 0.002),
        )  # fmt: skip
        shell(finger, "rubber", _block((-0.0095, 0.0002, 0.032), (0.0095, 0.005, 0.0518), 0.001))


class _Sculptor:
    """Adds to a body the convex hull of point clouds, as a geom that touches nothing and weighs nothing."""

    def __init__(self, spec: mujoco.MjSpec) -> None:
        self._spec = spec

    def __call__(self, body: str, material: str, *clouds: Points) -> None:
        name = f"shell{len(self._spec.meshes)}"
        self._spec.add_mesh(name=name, uservert=np.concatenate(clouds).ravel())
        geom = self._spec.body(body).add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
        _only_seen(geom, material)


def _only_seen(geom: Any, material: str) -> None:
    geom.material = material
    geom.contype = geom.conaffinity = 0
    geom.mass = 0.0
    geom.group = 1


def _ball(center: Vector, radius: float) -> Points:
    polar, around = np.meshgrid(np.linspace(0, np.pi, 15), np.arange(32) * (np.pi / 16), indexing="ij")
    unit = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
    return np.asarray(center) + radius * unit.reshape(-1, 3)


def _drum(center: Vector, axis: Vector, radius: float, half_length: float, rounding: float = 0.008) -> Points:
    """A cylinder with rounded rims."""
    rounding = min(rounding, half_length)
    along = np.asarray(axis)
    side = np.roll(along, 1)
    around = np.arange(48) * (np.pi / 24)
    rim = np.cos(around)[:, None] * side + np.sin(around)[:, None] * np.cross(along, side)
    clouds = []
    for angle in np.linspace(0, np.pi / 2, 5):
        ring = (radius - rounding * (1 - np.cos(angle))) * rim
        height = (half_length - rounding * (1 - np.sin(angle))) * along
        clouds += [np.asarray(center) + ring + height, np.asarray(center) + ring - height]
    return np.concatenate(clouds)


def _block(lower: Vector, upper: Vector, rounding: float) -> Points:
    """A box with rounded edges."""
    low, high = np.asarray(lower) + rounding, np.asarray(upper) - rounding
    corners = [np.where(pick, high, low) for pick in np.ndindex(2, 2, 2)]
    return np.concatenate([_ball(tuple(corner), rounding) for corner in corners])


# --- surroundings --------------------------------------------------------------------------------------------------


def _add_table(spec: mujoco.MjSpec) -> None:
    _add_texture_material(spec, "wood", _wood(), 512)
    half_x, half_y, _ = TABLE_HALF_SIZE_M
    _box(spec, "wood", (TABLE_CENTER_X_M, 0, -_TABLE_THICKNESS_M / 2), (half_x, half_y, _TABLE_THICKNESS_M / 2))
    leg_half = (-_FLOOR_Z_M - _TABLE_THICKNESS_M) / 2
    for x in (-1, 1):
        for y in (-1, 1):
            center = (TABLE_CENTER_X_M + x * (half_x - 0.06), y * (half_y - 0.06), _FLOOR_Z_M + leg_half)
            _box(spec, "leg", center, (0.025, 0.025, leg_half))
    _box(spec, "leg", (TABLE_CENTER_X_M, 0, -_TABLE_THICKNESS_M - 0.025), (half_x - 0.05, half_y - 0.05, 0.025))


def _wood() -> NDArray[np.uint8]:
    """(512, 512, 3) of light maple: slow streaks along one direction, fine grain across."""
    rng = np.random.default_rng(7)
    along, across = np.meshgrid(np.linspace(0, 1, 512), np.linspace(0, 1, 512))
    warp = 0.02 * np.sin(2 * np.pi * (along + 0.3)) + 0.008 * np.sin(2 * np.pi * (3 * along + across))
    streaks = sum(
        np.sin(2 * np.pi * (frequency * (across + warp) + phase)) / (1 + 0.1 * frequency)
        for frequency, phase in zip((3, 7, 13, 29, 53, 97), rng.random(6), strict=True)
    )
    grain = rng.normal(size=512)[:, None] * 0.35
    shade = 1.0 + 0.022 * (streaks + grain)
    return np.clip(255 * shade[:, :, None] * np.array([0.80, 0.70, 0.57]), 0, 255).astype(np.uint8)


def _add_texture_material(spec: mujoco.MjSpec, name: str, image: NDArray[np.uint8], size: int) -> None:
    spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=size, height=size, nchannel=3, data=image.tobytes()
    )
    material = spec.add_material(name=name, specular=0.12, shininess=0.25)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _add_room(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.93, 0.95, 0.97), rgb2=(0.62, 0.70, 0.79), width=256, height=256 * 6,
    )  # fmt: skip
    spec.add_texture(
        name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.70, 0.73, 0.76), rgb2=(0.66, 0.69, 0.72), width=256, height=256,
    )  # fmt: skip
    floor = spec.add_material(name="floor", texrepeat=(1.5, 1.5), texuniform=True, specular=0.1, shininess=0.1)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    plane = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 0.05), pos=(0, 0, _FLOOR_Z_M))
    _only_seen(plane, "floor")
    spec.worldbody.add_light(
        pos=(0.7, -0.9, 1.9), dir=(-0.5, 0.5, -1.0), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=(0.52, 0.51, 0.49), specular=(0.3, 0.3, 0.3), castshadow=True,
    )  # fmt: skip
    spec.worldbody.add_light(
        pos=(0.8, 1.2, 1.6), dir=(-0.7, -0.8, -0.8), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=(0.22, 0.23, 0.25), specular=(0.1, 0.1, 0.1), castshadow=False,
    )  # fmt: skip
    visual = spec.visual
    visual.headlight.ambient = (0.34, 0.34, 0.35)
    visual.headlight.diffuse = (0.16, 0.16, 0.16)
    visual.headlight.specular = (0.0, 0.0, 0.0)
    visual.global_.fovy = 32.0
    visual.quality.shadowsize = 2048
    visual.quality.offsamples = 4
    visual.map.znear = 0.02
    visual.map.zfar = 30.0
    visual.rgba.haze = (0.80, 0.84, 0.88, 1.0)
    visual.map.haze = 0.35
    spec.stat.extent = 1.3
    spec.stat.center = (-0.25, 0.0, 0.15)


def _add_workspace(spec: mujoco.MjSpec, workspace: WorkspaceConfig) -> None:
    """Its outline on the table, faint upright and upper edges, and a breath of colour inside."""
    half = np.array([workspace.length_x_m, workspace.length_y_m]) / 2
    low = np.array([workspace.center_x_m - half[0], workspace.center_y_m - half[1], 0.001])
    high = np.array([workspace.center_x_m + half[0], workspace.center_y_m + half[1], workspace.height_m])
    for axis in range(3):
        for pick in np.ndindex(2, 2):
            ends = np.empty((2, 3))
            ends[:, axis] = low[axis], high[axis]
            for other, upper in zip([other for other in range(3) if other != axis], pick, strict=True):
                ends[:, other] = high[other] if upper else low[other]
            on_table = ends[:, 2].max() < 0.01
            line = spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=(0.002 if on_table else 0.001, 0, 0), fromto=ends.ravel()
            )
            _only_seen(line, "outline" if on_table else "edge")
    _box(spec, "volume", (low + high) / 2, (high - low) / 2)


def _box(spec: mujoco.MjSpec, material: str, center: Sequence[float] | Points, half: Sequence[float] | Points) -> None:
    _only_seen(spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=center, size=half), material)
