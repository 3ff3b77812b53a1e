"""What is in the way of an object at a place: fixtures, a box, obstacles, the table, the gripper, other objects.

Things are as they were described, not turned, so each is in an upright box, and two are clear of each other where their
boxes are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from service.base.types import BoolArray, StateArray
from service.config import WorldConfig
from service.config.objects import FixtureConfig, ObjectConfig
from service.envs import scene
from service.envs.objects import GRIPPER_BIT
from service.envs.observations import each_object

_TOUCHES_M = 0.001
"""An object that stands on a fixture is not inside it, however its place was rounded."""


class Boxes(NamedTuple):
    """Upright boxes by two corners, metres: (M, 3) the same in all worlds, or (N, M, 3)."""

    lower: StateArray
    upper: StateArray


def gripper_boxes(model: mujoco.MjModel, data: mujoco.MjData) -> Boxes:
    """Boxes around what may touch of a gripper, where it is in ``data``."""
    solid = np.flatnonzero(model.geom_contype == GRIPPER_BIT)
    turned = data.geom_xmat[solid].reshape(-1, 3, 3)
    center = data.geom_xpos[solid] + np.einsum("gij,gj->gi", turned, model.geom_aabb[solid, :3])
    half = np.einsum("gij,gj->gi", np.abs(turned), model.geom_aabb[solid, 3:])
    return Boxes(center - half, center + half)


def inside_obstacles(position: StateArray, obstacles: StateArray, config: WorldConfig) -> BoolArray:
    """(N,) whether an object at its place of (N, 3 K) would be inside one of the obstacles at (N, M, 3), metres."""
    half = np.array([each.extent_m for each in config.obstacles]).reshape(-1, 3) / 2
    others = Boxes(obstacles - half, obstacles + half)
    return _some_object(position, config, lambda around: overlaps(around, others))


def inside_fixtures(position: StateArray, config: WorldConfig) -> BoolArray:
    """(N,) whether an object at its place of (N, 3 K) would be more than a millimetre inside a fixture or the wall.

    A box, which is elsewhere in every game, is none of them: see ``inside_box``.
    """
    fixtures = boxes_around_fixtures(config)
    return _some_object(position, config, lambda around: overlaps(_smaller(around), fixtures))


def inside_box(position: StateArray, box: StateArray, config: WorldConfig, *, bottom: bool) -> BoolArray:
    """(N,) whether an object at its place of (N, 3 K) would be more than a millimetre inside a side of a box.

    Args:
        position: metres.
        box: (N, 3) the middle of its bottom; (N, 0) in worlds without.
        config: the world.
        bottom: whether it must not be inside the bottom, either; goals are (``draw_goals``).
    """
    if not box.size:
        return np.zeros(len(position), dtype=bool)
    parts = scene.BOX_PARTS if bottom else scene.BOX_PARTS[1:]
    middle, half = (np.array([part[number] for part in parts]) for number in (1, 2))
    shell = Boxes(box[:, None] + middle - half, box[:, None] + middle + half)
    return _some_object(position, config, lambda around: overlaps(_smaller(around), shell))


def inside_each_other(position: StateArray, config: WorldConfig) -> BoolArray:
    """(N,) whether objects at their places of (N, 3 K) would be more than a millimetre inside each other."""
    place, inside = each_object(position), np.zeros(len(position), dtype=bool)
    around = [_smaller(boxes_around(place[:, index], body)) for index, body in enumerate(config.bodies)]
    for index, each in enumerate(around[1:], start=1):
        others = Boxes(*(np.stack(corners, axis=1) for corners in zip(*around[:index], strict=True)))
        inside |= overlaps(each, others)
    return inside


def inside_table(position: StateArray, config: WorldConfig) -> BoolArray:
    """(N,) whether an object at its place of (N, 3 K) would be inside the table, however it lies there."""
    low: BoolArray = each_object(position)[:, :, 2] < np.subtract(config.lowest_heights_m, _TOUCHES_M)
    inside: BoolArray = np.any(low, axis=1)
    return inside


def inside_gripper_or_table(position: StateArray, config: WorldConfig, gripper: Boxes, rest_m: StateArray) -> BoolArray:
    """(N,) whether an object at its place of (N, 3 K) would be more than a millimetre inside of these.

    On the table, objects rest at heights of (K,) or (N, K) ``rest_m``.
    """
    low = (each_object(position)[:, :, 2] < rest_m - _TOUCHES_M).any(axis=1)
    inside: BoolArray = low | _some_object(position, config, lambda around: overlaps(_smaller(around), gripper))
    return inside


def _smaller(around: Boxes) -> Boxes:
    """Boxes that do not reach into what they only touch, however places were rounded."""
    return Boxes(around.lower + _TOUCHES_M, around.upper - _TOUCHES_M)


def _some_object(position: StateArray, config: WorldConfig, test: Callable[[Boxes], BoolArray]) -> BoolArray:
    """(N,) whether the boxes around one of the objects at (N, 3 K) pass a test."""
    place = each_object(position)
    tested = [test(boxes_around(place[:, index], body)) for index, body in enumerate(config.bodies)]
    return tested[0] if len(tested) == 1 else np.any(tested, axis=0)


def boxes_around(position: StateArray, shape: ObjectConfig) -> Boxes:
    """(N, 3) boxes around a thing at (N, 3) places."""
    half = np.array(shape.extent_m) / 2
    return Boxes(position - half, position + half)


def boxes_around_fixtures(config: WorldConfig) -> Boxes:
    """Boxes around all fixtures that are described, or around the wall."""
    if config.fixture != "wall":
        return boxes_of(config.fixtures)
    workspace = config.workspace
    half = np.array([scene.WALL_THICKNESS_M, workspace.length_y_m, 2 * scene.WALL_HEIGHT_M]) / 2
    middle = np.array([[workspace.center_x_m, workspace.center_y_m, 0.0]])
    return Boxes(middle - half, middle + half)


def boxes_of(fixtures: Sequence[FixtureConfig]) -> Boxes:
    """(F, 3) boxes around F fixtures."""
    corners = np.array([each.corners_m for each in fixtures]).reshape(-1, 2, 3)
    return Boxes(corners[:, 0], corners[:, 1])


def join(one: Boxes, other: Boxes) -> Boxes:
    """All boxes of both."""
    return Boxes(*(np.concatenate(pair) for pair in zip(one, other, strict=True)))


def overlaps(one: Boxes, others: Boxes) -> BoolArray:
    """(N,) whether (N, 3) boxes overlap one of ``others``."""
    overlapping = (one.lower[:, None] < others.upper) & (one.upper[:, None] > others.lower)
    some: BoolArray = np.any(np.all(overlapping, axis=-1), axis=1)
    return some
