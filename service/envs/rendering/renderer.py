"""Pictures of a world: MuJoCo's own renderer, offscreen, on states of a ``WorldBatch``.

The model that is drawn is the physics with its decoration; both have the same states. OpenGL is touched when a
``SceneRenderer`` is made and not before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from service.base.types import StateArray
from service.config import WorldConfig
from service.config.objects import Color
from service.envs.objects import geometry
from service.envs.observations import each_object
from service.envs.rendering.camera import DEFAULT_VIEW, CameraView
from service.envs.rendering.decoration import decorate
from service.envs.rendering.gl import open_drawing
from service.envs.scene import build_layout, build_spec

Image = NDArray[np.uint8]

_GOAL_COLORS = ((0.0, 0.62, 0.45), (0.90, 0.62, 0.0))
_GOAL_ALPHA, _DROP_ALPHA = 0.45, 0.7
_DROP_RADIUS_M, _FOOT_RADIUS_M, _FOOT_HALF_HEIGHT_M = 0.0015, 0.012, 0.0006
_MORE_GEOMS = 200
"""That may be drawn beyond those of the model: three for each goal, and tendons of a user's robot."""
_NUM_SAMPLES = 4
_NOT_TURNED = np.eye(3).ravel()


class SceneRenderer:
    """Renderer of the states of a ``WorldBatch`` of the same configuration; for use in the thread that made it.

    Args:
        config: the world.
        width: of the pictures, pixels.
        height: of the pictures, pixels.
        view: where they are taken from.

    Raises:
        TandemError: this machine has no OpenGL that works without a window.
    """

    def __init__(
        self, config: WorldConfig, width: int = 640, height: int = 480, view: CameraView = DEFAULT_VIEW
    ) -> None:
        self.camera = view.camera()
        """Place the pictures are taken from; it may be moved at any time."""
        self.model = _build_model(config, width, height)
        self._data = mujoco.MjData(self.model)
        self._layout = build_layout(config)  # the flag of a blocked gripper follows everything that is read here
        colors = goal_colors([body.color for body in config.bodies])
        self._goals = list(zip(map(geometry, config.bodies), config.rest_heights_m, colors, strict=True))
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._option = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(self.model, maxgeom=self.model.ngeom + _MORE_GEOMS)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = True
        self._context, self._drawing = open_drawing(self.model, width, height)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Free OpenGL's memory; nothing can be drawn afterwards."""
        if self._context is not None:
            self._context.make_current()
            self._drawing.free()
            self._context.free()
            self._context = None

    def render(self, state: StateArray, goal: StateArray | None = None, size: tuple[int, int] | None = None) -> Image:
        """Draw one world.

        Args:
            state: (S,) row of ``WorldBatch.states``.
            goal: (3 K,) metres, shown as transparent copies of the objects; None for none.
            size: width and height of this picture, pixels, at most those of the renderer; None for those.

        Returns:
            (H, W, 3), the top row first.
        """
        assert self._context is not None, "drawing after close"
        mujoco.mj_setState(self.model, self._data, state[self._layout.physics], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        if self.model.nmocap:
            self._data.mocap_pos[0] = state[self._layout["box_place"]]
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_camlight(self.model, self._data)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self.model, self._data, self._option, None, self.camera, everything, self._scene)
        if goal is not None:
            for place, (shape, rest_height_m, color) in zip(each_object(np.asarray(goal)), self._goals, strict=True):
                self._add_goal(np.asarray(place, dtype=np.float64), shape, rest_height_m, color)
        self._context.make_current()
        rectangle = self._rectangle if size is None else mujoco.MjrRect(0, 0, *size)
        image = np.empty((rectangle.height, rectangle.width, 3), dtype=np.uint8)
        mujoco.mjr_render(rectangle, self._scene, self._drawing)
        mujoco.mjr_readPixels(image, None, rectangle, self._drawing)
        return np.ascontiguousarray(image[::-1])

    def _add_goal(self, goal: StateArray, shape: Any, rest_height_m: float, color: Color) -> None:
        """Add a transparent copy of an object, and a line down to the table, which shows its height."""
        kind, size, quaternion = shape
        turned = np.empty(9)
        mujoco.mju_quat2Mat(turned, np.array(quaternion))
        self._add(kind, size, goal, (*color, _GOAL_ALPHA), turned)
        cylinder, foot = mujoco.mjtGeom.mjGEOM_CYLINDER, np.array([goal[0], goal[1], 0.0])
        self._add(cylinder, (_FOOT_RADIUS_M, _FOOT_HALF_HEIGHT_M, 0.0), foot, (*color, _DROP_ALPHA))
        half_drop = (goal[2] - rest_height_m) / 2
        if half_drop > _FOOT_HALF_HEIGHT_M:
            middle = np.array([goal[0], goal[1], half_drop])
            self._add(cylinder, (_DROP_RADIUS_M, half_drop, 0.0), middle, (*color, _DROP_ALPHA))

    def _add(
        self,
        kind: Any,
        size: Any,
        position: StateArray,
        rgba: tuple[float, float, float, float],
        turned: StateArray = _NOT_TURNED,
    ) -> None:
        geom = self._scene.geoms[self._scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.asarray(size), position, turned, np.array(rgba, dtype=np.float32))
        geom.category, geom.castshadow = mujoco.mjtCatBit.mjCAT_DECOR, 0
        geom.emission, geom.specular = 0.25, 0.2
        self._scene.ngeom += 1


def _build_model(config: WorldConfig, width: int, height: int) -> mujoco.MjModel:
    spec = build_spec(config)
    decorate(spec, config)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.quality.offsamples = _NUM_SAMPLES
    # Without a graphics card the shadow map is a third of the work; twice the picture's size is enough for it.
    spec.visual.quality.shadowsize = int(np.clip(2 ** np.ceil(np.log2(2 * height)), 256, 2048))
    return spec.compile()


def goal_colors(colors: Sequence[Color]) -> Sequence[Color]:
    """Colors of the goals of objects: of several their own; of one green, or orange where it is nearer to green.

    Both are Okabe and Ito's, which colour-blind readers tell apart.
    """
    if len(colors) > 1:
        return colors
    return [max(_GOAL_COLORS, key=lambda goal: math.dist(goal, color)) for color in colors]
