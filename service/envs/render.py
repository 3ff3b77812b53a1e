"""Pictures of a world: MuJoCo's own renderer, offscreen, on states of a ``WorldBatch``.

A second model is drawn, the physics with its decoration; states of one are states of the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from service.config import WorldConfig
from service.envs.gl import RenderError, open_context
from service.envs.looks import OBJECT_RGB, decorate
from service.envs.scene import build_spec

__all__ = ["DEFAULT_CAMERA", "TOP_CAMERA", "Camera", "RenderError", "SceneRenderer", "decorate"]

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

_GOAL_RGBA = (*OBJECT_RGB, 0.38)
_DROP_RGBA = (*OBJECT_RGB, 0.30)
_MAX_GEOMS = 200


@dataclass(frozen=True, slots=True)
class Camera:
    """Where the picture is taken from: it looks at a point from a distance in a direction."""

    target: tuple[float, float, float]
    """Point in the middle of the picture, metres."""
    distance_m: float
    azimuth_deg: float
    """Direction of the view in the table's plane: 0 looks along x, 90 along y."""
    elevation_deg: float
    """-90 looks straight down."""


DEFAULT_CAMERA = Camera((-0.20, 0.0, 0.20), 2.05, 146.0, -21.0)
"""Three-quarter view from the front: arm, workspace and object."""
TOP_CAMERA = Camera((-0.20, 0.0, 0.05), 2.2, 180.0, -72.0)
"""From above, the robot at the top."""


class SceneRenderer:
    """Draws states of a ``WorldBatch`` of the same configuration.

    Args:
        config: the world.
        width, height: of the pictures, pixels.
        camera: where they are taken from.

    Raises:
        RenderError: this machine has no OpenGL.
    """

    def __init__(
        self, config: WorldConfig, width: int = 640, height: int = 480, camera: Camera = DEFAULT_CAMERA
    ) -> None:
        spec = build_spec(config)
        decorate(spec, config)
        spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
        self.model = spec.compile()
        self.camera = camera
        self._object_is_cube, self._object_half_m = config.object == "cube", config.object_size_m / 2
        self._data = mujoco.MjData(self.model)
        self._state_size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self._scene = mujoco.MjvScene(self.model, maxgeom=_MAX_GEOMS)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = True
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._context = open_context(width, height)
        self._drawing = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._drawing)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Free the OpenGL context; nothing can be drawn afterwards."""
        if self._context is not None:
            self._context.make_current()
            self._drawing.free()
            self._context.free()
            self._context = None

    def render(self, state: Array, goal: Array | None = None) -> Image:
        """Draw one world.

        Args:
            state: (S,) row of ``WorldBatch.states``.
            goal: (3,) metres, shown as a transparent copy of the object; None for none.

        Returns:
            (H, W, 3), top row first.
        """
        assert self._context is not None, "rendering after close"
        mujoco.mj_setState(self.model, self._data, state[: self._state_size], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_camlight(self.model, self._data)
        mujoco.mjv_updateScene(
            self.model, self._data, mujoco.MjvOption(), None, self._free_camera(), mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        if goal is not None:
            self._add_goal(np.asarray(goal, dtype=np.float64))
        self._context.make_current()
        image = np.empty((self._rectangle.height, self._rectangle.width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._rectangle, self._scene, self._drawing)
        mujoco.mjr_readPixels(image, None, self._rectangle, self._drawing)
        return np.ascontiguousarray(image[::-1])

    def _free_camera(self) -> Any:
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat, camera.distance = self.camera.target, self.camera.distance_m
        camera.azimuth, camera.elevation = self.camera.azimuth_deg, self.camera.elevation_deg
        return camera

    def _add_goal(self, goal: Array) -> None:
        """A ghost of the object, and a line down to the table, which tells its height."""
        half = np.full(3, self._object_half_m)
        self._add(mujoco.mjtGeom.mjGEOM_BOX if self._object_is_cube else mujoco.mjtGeom.mjGEOM_SPHERE, half, goal, _GOAL_RGBA)
        foot = np.array([goal[0], goal[1], 0.001])
        self._add(mujoco.mjtGeom.mjGEOM_CYLINDER, np.array([0.012, 0.012, 0.0006]), foot, _DROP_RGBA)
        drop = (goal[2] - self._object_half_m) / 2
        if drop > 0.0:
            self._add(mujoco.mjtGeom.mjGEOM_CYLINDER, np.array([0.0015, 0.0015, drop]), foot + (0, 0, drop), _DROP_RGBA)

    def _add(self, kind: Any, size: Array, position: Array, rgba: tuple[float, ...]) -> None:
        geom = self._scene.geoms[self._scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, size, position, np.eye(3).ravel(), np.asarray(rgba, dtype=np.float32))
        geom.category, geom.emission, geom.specular = mujoco.mjtCatBit.mjCAT_DECOR, 0.25, 0.2
        self._scene.ngeom += 1
