"""Decoration of the scene for pictures: the Panda's covers, table, floor, sky, light, and the workspace's edges.

All of it is made from numbers. No part collides, weighs anything or moves by itself, so a
state of the physics model is a state of the decorated one.
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
from service.envs.objects import FLOOR_Z_M
from service.envs.rendering.panda_visuals import add_panda_visuals, make_visual
from service.envs.scene import FIXTURE_PREFIX, TABLE_CENTER_X_M, TABLE_HALF_SIZE_M

_TABLE_THICKNESS_M = 0.035
_TEXTURE_SIZE = 512
_MATERIALS: dict[str, dict[str, Any]] = {
    "object": {"specular": 0.35, "shininess": 0.5},
    "fixture": {"rgba": (0.42, 0.47, 0.54, 1.0), "specular": 0.3, "shininess": 0.4},
    "leg": {"rgba": (0.24, 0.25, 0.27, 1.0), "specular": 0.2, "shininess": 0.3},
    "outline": {"rgba": (0.10, 0.36, 0.62, 0.85), "emission": 0.3, "specular": 0.0},
    "edge": {"rgba": (0.10, 0.36, 0.62, 0.22), "emission": 0.3, "specular": 0.0},
    "volume": {"rgba": (0.10, 0.40, 0.80, 0.05), "emission": 0.5, "specular": 0.0},
}


def decorate(spec: mujoco.MjSpec, config: WorldConfig) -> None:
    """Add everything that is only drawn to the physics of ``scene.build_spec``; the layout of its state stays."""
    for name, properties in _MATERIALS.items():
        spec.add_material(name=name, **properties)
    if config.robot == "panda":  # others come with what they look like
        add_panda_visuals(spec)
    _add_table(spec)
    _add_floor_and_sky(spec)
    _add_lights(spec)
    _add_workspace(spec, config.workspace)
    spec.material("object").rgba = (*config.shape.color, 1.0)
    for geom in spec.body("object").geoms:
        geom.material = "object"
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
    make_visual(plane, "floor", casts_shadow=False)
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
        make_visual(line, "outline" if on_table else "edge", casts_shadow=False)
    _box(spec, "volume", (low + high) / 2, (high - low) / 2, casts_shadow=False)


def _textured(spec: mujoco.MjSpec, name: str, **properties: Any) -> None:
    """Add a material of the texture of the same name."""
    spec.add_material(name=name, **properties).textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _box(
    spec: mujoco.MjSpec, material: str, center: Sequence[float] | StateArray, half: Sequence[float] | StateArray,
    *, casts_shadow: bool = True,
) -> None:  # fmt: skip
    geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=center, size=half)
    make_visual(geom, material, casts_shadow=casts_shadow)
