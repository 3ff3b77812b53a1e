"""The world as the browser shows it: shapes by mjviser from the decorated model, and a goal that can be dragged."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from service.base.types import StateArray
from service.config import WorldConfig
from service.envs.rendering.camera import DEFAULT_VIEW
from service.envs.rendering.decoration import decorate
from service.envs.rendering.renderer import goal_color
from service.envs.scene import build_layout, build_spec

_HIDDEN = ("volume",)
"""Materials that are seen through, which mjviser does not draw so."""
_PLAIN = {"wood": (0.80, 0.70, 0.57, 1.0)}
"""Colours of materials whose texture mjviser does not draw on boxes."""
_GOAL_OPACITY = 0.5
_FIELD_OF_VIEW_RAD = 0.75
_HANDLE_M = 0.12
"""Length of the arrows by which the goal is dragged."""


class LiveScene:
    """Shapes of one world on a ``viser`` server."""

    def __init__(self, server: Any, world: WorldConfig) -> None:
        from mjviser.conversions import merge_geoms
        from mjviser.scene import ViserMujocoScene

        spec = build_spec(world)
        decorate(spec, world)
        self.model = _plain(spec.compile())
        self._data = mujoco.MjData(self.model)
        self._layout = build_layout(world)
        self._scene = ViserMujocoScene(server, self.model, num_envs=1)
        self._scene.camera_tracking_enabled = False
        self._server = server
        rest = world.rest_height_m
        low, high = (*world.workspace.lower_m[:2], rest), world.workspace.upper_m
        self.goal = server.scene.add_transform_controls(
            "/goal",
            scale=_HANDLE_M,
            disable_rotations=True,
            disable_sliders=True,
            depth_test=False,
            translation_limits=tuple(zip(low, high, strict=True)),
        )
        """The handle of the goal; its ``position`` is where a user dragged it."""
        geoms = [geom for geom in range(self.model.ngeom) if self.model.geom(geom).name.startswith("object")]
        shape = merge_geoms(self.model, geoms)
        server.scene.add_mesh_simple(
            "/goal/shape",
            np.asarray(shape.vertices, dtype=np.float32),
            np.asarray(shape.faces, dtype=np.uint32),
            color=goal_color(world.shape.color),
            opacity=_GOAL_OPACITY,
            cast_shadow=False,
        )
        server.initial_camera.position = DEFAULT_VIEW.position_m
        server.initial_camera.look_at = DEFAULT_VIEW.lookat_m
        server.initial_camera.fov = _FIELD_OF_VIEW_RAD

    def draw(self, before: StateArray, after: StateArray, share: float) -> None:
        """Show the world between two states.

        Args:
            before: (S,) state of the world.
            after: (S,) the next one.
            share: 0 at ``before``, 1 at ``after``.
        """
        state = before + share * (after - before)
        everything = mujoco.mjtState.mjSTATE_FULLPHYSICS
        mujoco.mj_setState(self.model, self._data, state[self._layout.physics], everything)
        mujoco.mj_normalizeQuat(self.model, self._data.qpos)
        if self.model.nmocap:
            self._data.mocap_pos[0] = state[self._layout["box_place"]]
        mujoco.mj_kinematics(self.model, self._data)
        self._scene.update_from_mjdata(self._data)

    def place_goal(self, goal: StateArray, *, visible: bool) -> None:
        """Show the goal at (3,) metres, or nowhere."""
        if not np.allclose(self.goal.position, goal, atol=1e-6):
            self.goal.position = tuple(goal)
        if self.goal.visible != visible:
            self.goal.visible = visible


def _plain(model: mujoco.MjModel) -> mujoco.MjModel:
    """Change how a model looks to what mjviser can draw."""
    for material in range(model.nmat):
        name = model.material(material).name
        if name in _PLAIN:
            model.mat_rgba[material] = _PLAIN[name]
            model.mat_texid[material] = -1
        if name in _HIDDEN:
            model.geom_rgba[model.geom_matid == material, 3] = 0.0
    return model
