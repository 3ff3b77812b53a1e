"""What may stand on the table besides the object: a wall across the workspace, or an open box.

Neither can be moved. The wall is part of the table; the box is elsewhere in every world, so its place is part of a
world's state (three numbers behind MuJoCo's own). Both are touched by the object, the hand and the fingers; the arm's
links collide with nothing, and a gripper that points down keeps them far above (the wrist is 21 cm over the fingertips).
Sizes and where objects and goals are drawn: docs/decisions/0007.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from service.config import WorldConfig
from service.envs import panda

StateArray = NDArray[np.float64]

PLACE_SIZE = 3
"""Numbers in a state that say where the box is: the middle of its bottom, metres."""

WALL_THICKNESS_M = 0.01
WALL_HEIGHT_M = 0.07
"""Higher than the cube, and so low that the hand does not touch it while the fingers hold a cube beside it."""
AREA_LENGTH_M = 0.15
"""Extent of each area beside the wall, away from it; along it they are as wide as the workspace (paper: 15 x 35 cm)."""

BOX_SIZE_M = 0.10
BOX_HEIGHT_M = 0.05
BOX_SHELL_M = 0.005
"""Thickness of its walls and bottom; paper: 10 x 10 x 5 cm, taken as the outside."""

GAP_M = 0.005
"""Least distance of a new object from wall or box."""
FINGER_GAP_M = 0.04
"""The same where a finger has to go in between: fingers open along y, and reach 3.7 cm beyond a 5 cm cube."""
_RGBA = (0.52, 0.56, 0.62, 1.0)


def add_fixture(spec: mujoco.MjSpec, config: WorldConfig, contact: dict[str, Any]) -> None:
    """Add the wall or the box of ``config.fixture`` to a model under construction.

    Args:
        spec: the model.
        config: the world.
        contact: ``solref`` and ``solimp`` of its surfaces.
    """
    workspace = config.workspace
    center = (workspace.center_x_m, workspace.center_y_m, 0.0)
    if config.fixture == "wall":
        half = (WALL_THICKNESS_M / 2, workspace.length_y_m / 2, WALL_HEIGHT_M / 2)
        _add_plate(spec.worldbody, "wall", (*center[:2], half[2]), half, config, contact)
    elif config.fixture == "box":
        body = spec.worldbody.add_body(name="box", pos=center, mocap=True)
        for name, (middle, half) in _plates().items():
            _add_plate(body, f"box_{name}", middle, half, config, contact)


def _plates() -> dict[str, tuple[tuple[float, ...], tuple[float, ...]]]:
    """Middle and half size of the box's bottom and walls."""
    outer, half_shell, half_height = BOX_SIZE_M / 2, BOX_SHELL_M / 2, BOX_HEIGHT_M / 2
    side, inner = outer - half_shell, outer - BOX_SHELL_M
    return {
        "bottom": ((0.0, 0.0, half_shell), (outer, outer, half_shell)),
        "near": ((-side, 0.0, half_height), (half_shell, outer, half_height)),
        "far": ((side, 0.0, half_height), (half_shell, outer, half_height)),
        "left": ((0.0, -side, half_height), (inner, half_shell, half_height)),
        "right": ((0.0, side, half_height), (inner, half_shell, half_height)),
    }


def _add_plate(
    body: Any, name: str, middle: tuple[float, ...], half: tuple[float, ...], config: WorldConfig, contact: Any
) -> None:
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=middle,
        size=half,
        contype=0,
        conaffinity=panda.GRIPPER_BIT | panda.OBJECT_BIT,
        friction=(config.friction, 0.005, 0.0001),
        group=2,
        rgba=_RGBA,
        **contact,
    )
