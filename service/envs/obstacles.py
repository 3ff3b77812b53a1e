"""Places at a start: of object, box and obstacles, clear of each other and of the gripper; and goals clear of them.

Things are as they were described, not turned, so each is in an upright box, and two are clear of each other where their
boxes are.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from service.base.errors import ConfigError
from service.base.types import BoolArray, StateArray
from service.config import WorldConfig
from service.config.objects import ObjectConfig
from service.envs import sampling, scene
from service.envs.contacts import GRIPPER_BIT
from service.envs.observations import OBSTACLE_PREFIX
from service.envs.sampling import GoalKind
from service.envs.state_layout import StateLayout

SEEN_WITHIN_M = 1.0
"""An obstacle further from the origin along an axis, such as one on the floor, is seen at this bound."""
_NUM_DRAWS = 20
"""Of the place of one obstacle, before all in a world are drawn anew."""
_NUM_ARRANGEMENTS = 60
_MAX_DRAWS = 1000
_COLUMNS_EACH = 7
"""Position and quaternion."""
_TOUCHES_M = 0.001
"""An object that stands on a fixture is not inside it, however its place was rounded."""
_BESIDE_OBJECT_M = np.array([scene.GAP_M, scene.FINGER_GAP_M, scene.GAP_M])


class Places(NamedTuple):
    """Where things are in N worlds, metres."""

    object: StateArray
    """(N, 3) its centre."""
    box: StateArray
    """(N, 3) the middle of its bottom; (N, 0) in worlds without."""
    obstacles: StateArray
    """(N, K, 3) their centres."""

    def of(self, worlds: slice) -> Places:
        """Those of some worlds."""
        return Places(*(each[worlds] for each in self))


class Boxes(NamedTuple):
    """Upright boxes by two corners, metres: (M, 3) the same in all worlds, or (N, M, 3)."""

    lower: StateArray
    upper: StateArray


def obstacle_columns(layout: StateLayout, num: int) -> slice:
    """Columns of a state that hold poses of ``num`` obstacles."""
    first = layout[f"{OBSTACLE_PREFIX}1"].start if num else 0
    return slice(first, first + _COLUMNS_EACH * num)


def obstacle_places(states: StateArray, columns: slice) -> StateArray:
    """(N, K, 3) centres of the obstacles of (N, S) states, metres; a view."""
    num = (columns.stop - columns.start) // _COLUMNS_EACH
    return states[:, columns].reshape(len(states), num, _COLUMNS_EACH)[:, :, :3]


def gripper_boxes(model: mujoco.MjModel, data: mujoco.MjData) -> Boxes:
    """Boxes around what may touch of a gripper, where it is in ``data``."""
    solid = np.flatnonzero(model.geom_contype == GRIPPER_BIT)
    turned = data.geom_xmat[solid].reshape(-1, 3, 3)
    center = data.geom_xpos[solid] + np.einsum("gij,gj->gi", turned, model.geom_aabb[solid, :3])
    half = np.einsum("gij,gj->gi", np.abs(turned), model.geom_aabb[solid, 3:])
    return Boxes(center - half, center + half)


def draw_starts(rng: np.random.Generator, num: int, config: WorldConfig, gripper: Boxes) -> Places:
    """Random places of what starts elsewhere in every game: see ``sampling.draw_starts`` for object and box.

    Obstacles lie on the table with their centres inside the workspace, clear of fixtures, the box, the gripper and each
    other, and so far from the object that an open finger fits between. Where some find no place, object and box are
    drawn anew, too.

    Raises:
        ConfigError: there is no room.
    """
    places = Places(*sampling.draw_starts(rng, num, config), np.empty((num, len(config.obstacles), 3)))
    standing = _join(_around_fixtures(config), gripper)
    left = np.arange(num)
    for _ in range(_NUM_ARRANGEMENTS):
        here = Places(*(each[left] for each in places))
        clear = ~_overlap(_around(here.object, config.shape), gripper)
        if config.obstacles:
            clear &= _place_obstacles(rng, here, config, standing)
            places.obstacles[left] = here.obstacles
        left = left[~clear]
        if not left.size:
            return places
        places.object[left], places.box[left] = sampling.draw_starts(rng, left.size, config)
    if not config.obstacles:
        raise ConfigError(
            f"world.object is {config.shape.extent_m[2]:g} m high and starts inside the gripper, wherever it is put: "
            f"raise world.start_height_m, which is {config.start_height_m:g}"
        )
    raise ConfigError(
        f"world.obstacles: no room in the workspace for the {len(config.obstacles)} of them beside the object, each "
        "other, fixtures and the gripper: leave some out, make them smaller, or make world.workspace larger"
    )


def draw_goals(
    kind: GoalKind, rng: np.random.Generator, config: WorldConfig, success_distance_m: float, places: Places
) -> StateArray:
    """(N, 3) goals of N worlds, metres, as ``sampling.draw_goals`` has them, but none inside an obstacle's place.

    Raises:
        TandemError: goals that such a world cannot have.
    """
    goal = sampling.draw_goals(kind, rng, config, success_distance_m, start=places.object, box=places.box)
    for _ in range(_MAX_DRAWS):
        inside = inside_obstacles(goal, places.obstacles, config)
        if not inside.any():
            return goal
        start, box = places.object[inside], places.box[inside]
        goal[inside] = sampling.draw_goals(kind, rng, config, success_distance_m, start=start, box=box)
    raise ConfigError(
        f"world.obstacles: the {len(config.obstacles)} of them leave no place for a goal: leave some out, or make "
        "world.workspace larger"
    )


def inside_obstacles(position: StateArray, obstacles: StateArray, config: WorldConfig) -> BoolArray:
    """(N,) whether an object at (N, 3) would be inside one of the obstacles at (N, K, 3), metres."""
    half = np.array([each.extent_m for each in config.obstacles]).reshape(-1, 3) / 2
    return _overlap(_around(position, config.shape), Boxes(obstacles - half, obstacles + half))


def inside_fixtures(position: StateArray, config: WorldConfig) -> BoolArray:
    """(N,) whether an object at (N, 3) would be more than a millimetre inside a fixture or the wall, metres.

    A box, which is elsewhere in every game, is none of them.
    """
    around = _around(position, config.shape)
    return _overlap(Boxes(around.lower + _TOUCHES_M, around.upper - _TOUCHES_M), _around_fixtures(config))


def _place_obstacles(rng: np.random.Generator, places: Places, config: WorldConfig, standing: Boxes) -> BoolArray:
    """Draw ``places.obstacles``; (N,) worlds where all are clear."""
    num = len(places.object)
    own = _around(places.object, config.shape)
    taken = [Boxes(own.lower - _BESIDE_OBJECT_M + scene.GAP_M, own.upper + _BESIDE_OBJECT_M - scene.GAP_M)]
    if places.box.size:
        half = np.array([scene.BOX_SIZE_M / 2, scene.BOX_SIZE_M / 2, 0.0])
        taken.append(Boxes(places.box - half, places.box + half + [0.0, 0.0, scene.BOX_HEIGHT_M]))
    all_clear = np.ones(num, dtype=bool)
    for index, obstacle in enumerate(config.obstacles):
        others = Boxes(np.stack([each.lower for each in taken], 1), np.stack([each.upper for each in taken], 1))
        here = np.empty((num, 3))
        blocked = np.ones(num, dtype=bool)
        for _ in range(_NUM_DRAWS):
            here[blocked] = sampling.sample_on_table(
                rng, int(blocked.sum()), config.workspace, object_height_m=obstacle.extent_m[2]
            )
            around = _around(here, obstacle)
            beside = Boxes(around.lower - scene.GAP_M, around.upper + scene.GAP_M)
            blocked = _overlap(beside, standing) | _overlap(beside, others)
            if not blocked.any():
                break
        all_clear &= ~blocked
        places.obstacles[:, index] = here
        taken.append(_around(here, obstacle))
    return all_clear


def _around(position: StateArray, shape: ObjectConfig) -> Boxes:
    """(N, 3) boxes around a thing at (N, 3) places."""
    half = np.array(shape.extent_m) / 2
    return Boxes(position - half, position + half)


def _around_fixtures(config: WorldConfig) -> Boxes:
    lower, upper = ([getattr(each, corner) for each in config.fixtures] for corner in ("lower_m", "upper_m"))
    boxes = Boxes(np.reshape(lower, (-1, 3)), np.reshape(upper, (-1, 3)))
    if config.fixture != "wall":
        return boxes
    workspace = config.workspace
    half = np.array([scene.WALL_THICKNESS_M, workspace.length_y_m, 2 * scene.WALL_HEIGHT_M]) / 2
    middle = np.array([[workspace.center_x_m, workspace.center_y_m, 0.0]])
    return _join(boxes, Boxes(middle - half, middle + half))


def _join(one: Boxes, other: Boxes) -> Boxes:
    return Boxes(*(np.concatenate(pair) for pair in zip(one, other, strict=True)))


def _overlap(one: Boxes, others: Boxes) -> BoolArray:
    """(N,) whether (N, 3) boxes overlap one of ``others``."""
    overlapping = (one.lower[:, None] < others.upper) & (one.upper[:, None] > others.lower)
    some: BoolArray = np.any(np.all(overlapping, axis=-1), axis=1)
    return some
