"""Fixtures, which stand on the table besides the object: a wall across the workspace, or an open box.

Neither can be moved. The wall is part of the table; the box is elsewhere in every world, so its place is part of a
world's state (three numbers behind MuJoCo's own). Both are touched by the object, the hand and the fingers; the arm's
links collide with nothing, and a gripper that points down keeps them far above (its flange is at least 21 cm up).
Sizes and where objects and goals are drawn: docs/decisions/0007.
"""

from __future__ import annotations

from typing import Any

import mujoco

from service.config import WorldConfig
from service.envs import panda

_Vector = tuple[float, float, float]

PLACE_SIZE = 3
"""Size of a box's place in a state: the middle of its bottom, x, y, z, metres."""

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
_PREFIX = "fixture_"


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
        half: _Vector = (WALL_THICKNESS_M / 2, workspace.length_y_m / 2, WALL_HEIGHT_M / 2)
        middle = (center[0], center[1], half[2])
        _add_plate(spec.worldbody, "wall", middle, half, config, contact)
    elif config.fixture == "box":
        body = spec.worldbody.add_body(name="box", pos=center, mocap=True)
        for name, (middle, half) in _plates().items():
            _add_plate(body, name, middle, half, config, contact)


def fixture_geoms(spec: mujoco.MjSpec) -> list[Any]:
    """The geoms that ``add_fixture`` added."""
    return [geom for geom in spec.geoms if geom.name.startswith(_PREFIX)]


def _plates() -> dict[str, tuple[_Vector, _Vector]]:
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
    body: Any, name: str, middle: _Vector, half: _Vector, config: WorldConfig, contact: dict[str, Any]
) -> None:
    body.add_geom(
        name=f"{_PREFIX}{name}",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=middle,
        size=half,
        contype=0,
        conaffinity=panda.GRIPPER_BIT | panda.OBJECT_BIT,
        friction=(config.friction, 0.005, 0.0001),
        group=2,
        **contact,
    )
