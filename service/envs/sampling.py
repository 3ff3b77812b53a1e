"""Random places: of object, box and obstacles at a start, clear of each other and of the gripper; and of goals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from service.base.errors import ConfigError, TandemError
from service.base.types import BoolArray, StateArray
from service.config import WorkspaceConfig, WorldConfig
from service.config.objects import ObjectConfig
from service.config.run import SUCCESS_DISTANCE_M
from service.envs import scene
from service.envs.observations import each_object
from service.envs.overlap import Boxes, boxes_around, boxes_around_fixtures, boxes_of, inside_obstacles, overlaps

GoalKind = Literal["table", "air", "mixed", "volume", "one"]
GOAL_KINDS: tuple[GoalKind, ...] = get_args(GoalKind)
MIXED_AIR_SHARE = 0.7
"""Share of mixed goals drawn anywhere in the workspace's volume; the rest lie on the table (paper: p = 0.7)."""
_NUM_DRAWS = 20
"""Of the place of one obstacle, or of the object beside a box, before all in a world are drawn anew."""
_NUM_ARRANGEMENTS = 60
_MAX_DRAWS = 1000
_BESIDE_OBJECT_M = np.array([scene.GAP_M, scene.FINGER_GAP_M, scene.GAP_M])


class Places(NamedTuple):
    """Where things are in N worlds, metres."""

    object: StateArray
    """(N, 3 K) centres of the objects, one after the other."""
    box: StateArray
    """(N, 3) the middle of its bottom; (N, 0) in worlds without."""
    obstacles: StateArray
    """(N, M, 3) their centres; (N, 0, 3) where they are not known."""

    def of(self, worlds: slice | BoolArray | NDArray[np.intp]) -> Places:
        """Those of some worlds."""
        return Places(*(each[worlds] for each in self))


# --- starts -----------------------------------------------------------------------------------------------------------


def sample_on_table(
    rng: np.random.Generator, num: int, workspace: WorkspaceConfig, object_height_m: float
) -> StateArray:
    """(num, 3) object centres, uniform over the workspace's table area, resting on the table."""
    center = np.array([workspace.center_x_m, workspace.center_y_m])
    half = np.array([workspace.length_x_m, workspace.length_y_m]) / 2
    position = np.empty((num, 3))
    position[:, :2] = center + rng.uniform(-half, half, (num, 2))
    position[:, 2] = object_height_m / 2
    return position


def draw_first(rng: np.random.Generator, num: int, config: WorldConfig) -> Places:
    """Random starts of the first object, and of the box where there is one; all else is left out.

    Without a fixture, anywhere on the table inside the workspace; so far from fixtures that are described that an open
    finger fits between. Beside a wall, in one of its two areas, either with equal chance. With a box, the box's middle
    is anywhere in the workspace, and the object outside of it: as far as from other fixtures.

    Raises:
        ConfigError: there is no room.
    """
    box, no_obstacles = np.empty((num, 0)), np.empty((num, 0, 3))
    if config.fixture == "wall":
        return Places(_beside_wall(rng, rng.choice((-1.0, 1.0), num), config), box, no_obstacles)
    position = _clear_of_fixtures(lambda num: _on_table(rng, num, config), num, config, _BESIDE_OBJECT_M, config.shape)
    if config.fixture == "box":
        position, box = _beside_boxes(rng, position * (1.0, 1.0, 0.0), config)
    return Places(position, box, no_obstacles)


def draw_starts(rng: np.random.Generator, num: int, config: WorldConfig, gripper: Boxes) -> Places:
    """Random places of what starts elsewhere in every game: see ``draw_first`` for the first object and the box.

    The other objects and obstacles lie on the table with their centres inside the workspace, clear of fixtures, the
    box, the gripper and each other; an open finger fits between objects and what is beside them. Where some find no
    place, the first object and the box are drawn anew, too.

    Raises:
        ConfigError: there is no room.
    """
    others = (*config.bodies[1:], *config.obstacles)
    first, box, _ = draw_first(rng, num, config)
    beside = np.empty((num, len(others), 3))
    left = np.arange(num)
    for _ in range(_NUM_ARRANGEMENTS):
        clear = ~overlaps(boxes_around(first[left], config.shape), gripper)
        if others:
            beside[left], found_place = _place_others(rng, first[left], box[left], others, config, gripper)
            clear &= found_place
        left = left[~clear]
        if not left.size:
            further = beside[:, : config.num_objects - 1].reshape(num, 3 * (config.num_objects - 1))
            return Places(np.concatenate([first, further], axis=1), box, beside[:, config.num_objects - 1 :])
        first[left], box[left], _ = draw_first(rng, left.size, config)
    if not others:
        raise ConfigError(
            f"world.object is {config.shape.extent_m[2]:g} m high and starts inside the gripper, wherever it is put: "
            f"raise world.start_height_m, which is {config.start_height_m:g}"
        )
    things = [("object", config.num_objects), ("obstacle", len(config.obstacles))]
    there = " and ".join(f"{many} {name}{'s' * (many > 1)}" for name, many in things if many)
    raise ConfigError(
        f"world.workspace: no room in it for {there} beside each other, fixtures and the gripper: leave some out, make "
        "them smaller, raise world.start_height_m, or make the workspace larger"
    )


def _place_others(
    rng: np.random.Generator,
    first: StateArray,
    box: StateArray,
    others: Sequence[ObjectConfig],
    config: WorldConfig,
    gripper: Boxes,
) -> tuple[StateArray, BoolArray]:
    """(N, M, 3) random places of all things but the first object and the box; (N,) worlds where all are clear."""
    num, fixtures = len(first), boxes_around_fixtures(config)
    places, all_clear = np.empty((num, len(others), 3)), np.ones(num, dtype=bool)
    taken = [_beside(boxes_around(first, config.shape))]
    if box.size:
        half = np.array([scene.BOX_SIZE_M / 2, scene.BOX_SIZE_M / 2, 0.0])
        taken.append(Boxes(box - half, box + half + [0.0, 0.0, scene.BOX_HEIGHT_M]))
    for index, thing in enumerate(others):
        lying = Boxes(np.stack([each.lower for each in taken], 1), np.stack([each.upper for each in taken], 1))
        here = np.empty((num, 3))
        blocked = np.ones(num, dtype=bool)
        for _ in range(_NUM_DRAWS):
            here[blocked] = sample_on_table(rng, int(blocked.sum()), config.workspace, thing.extent_m[2])
            around = boxes_around(here, thing)
            beside = Boxes(around.lower - scene.GAP_M, around.upper + scene.GAP_M)
            room_m = _BESIDE_OBJECT_M if index < config.num_objects - 1 else scene.GAP_M
            apart_from = Boxes(around.lower - room_m, around.upper + room_m)
            blocked = overlaps(beside, gripper) | overlaps(apart_from, fixtures) | overlaps(beside, lying)
            if not blocked.any():
                break
        all_clear &= ~blocked
        places[:, index] = here
        around = boxes_around(here, thing)
        taken.append(_beside(around) if index < config.num_objects - 1 else around)
    return places, all_clear


def _beside(around: Boxes) -> Boxes:
    """Boxes of objects, and room for a finger beside them."""
    return Boxes(around.lower - _BESIDE_OBJECT_M + scene.GAP_M, around.upper + _BESIDE_OBJECT_M - scene.GAP_M)


def _on_table(rng: np.random.Generator, num: int, config: WorldConfig, shape: ObjectConfig | None = None) -> StateArray:
    """(num, 3) centres of an object, by default of the world's first one, resting on the table."""
    return sample_on_table(rng, num, config.workspace, (shape or config.shape).extent_m[2])


def _beside_wall(rng: np.random.Generator, side: StateArray, config: WorldConfig) -> StateArray:
    """(num, 3) object centres in the area on each (num,) side: -1 is nearer to the robot, 1 farther."""
    position = _on_table(rng, len(side), config)
    nearest = scene.WALL_THICKNESS_M / 2 + scene.GAP_M + config.shape.extent_m[0] / 2
    distance = nearest + rng.uniform(0.0, scene.AREA_LENGTH_M, len(side))
    position[:, 0] = config.workspace.center_x_m + side * distance
    return position


def _beside_boxes(rng: np.random.Generator, box: StateArray, config: WorldConfig) -> tuple[StateArray, StateArray]:
    """(num, 3) object centres in the workspace, and (num, 3) boxes; each is drawn again until both are clear.

    Raises:
        ConfigError: there is no room.
    """
    apart = scene.BOX_SIZE_M / 2 + np.array(config.shape.extent_m[:2]) / 2
    least = apart + np.array([scene.GAP_M, scene.FINGER_GAP_M])
    position, box = _on_table(rng, len(box), config), box.copy()
    for _ in range(_NUM_ARRANGEMENTS):
        for _ in range(_NUM_DRAWS):
            inside = (np.abs(position - box)[:, :2] < least).all(axis=1)
            if not inside.any():
                return position, box
            position[inside] = _on_table(rng, int(inside.sum()), config)
        box[inside] = _on_table(rng, int(inside.sum()), config) * (1.0, 1.0, 0.0)
    raise ConfigError(
        "world.fixture = 'box': no room in the workspace for the object beside the box: make world.workspace larger"
    )


def _clear_of_fixtures(
    draw: Callable[[int], StateArray], num: int, config: WorldConfig, gap_m: StateArray, shape: ObjectConfig
) -> StateArray:
    """(num, 3) centres of an object, each drawn again until it is that far from all described fixtures."""
    position, fixtures = draw(num), boxes_of(config.fixtures)
    for _ in range(_MAX_DRAWS):
        around = boxes_around(position, shape)
        inside = overlaps(Boxes(around.lower - gap_m, around.upper + gap_m), fixtures)
        if not inside.any():
            return position
        position[inside] = draw(int(inside.sum()))
    raise ConfigError(
        f"world.fixtures: the {len(config.fixtures)} of them leave no room for the object in the workspace: take some "
        "away, or make world.workspace larger"
    )


# --- goals ------------------------------------------------------------------------------------------------------------


def sample_goals(
    kind: GoalKind, rng: np.random.Generator, num: int, config: WorldConfig, success_distance_m: float
) -> StateArray:
    """(num, 3 K) goals, metres.

    ``table``: on it. ``air``: out of reach of an object that rests on the table. ``volume``: anywhere in the workspace
    (p = 1 in the paper's words). ``mixed``: as most of the paper's downstream tasks, anywhere in the volume with
    probability 0.7, else on the table. None is where the object would be inside a fixture.

    Of several objects, one has such a goal, and the others have goals on the table. They ``are_apart``.
    """
    if config.num_objects == 1:
        return _goals_of(config.shape, kind, rng, num, config, success_distance_m)

    def draw(num: int) -> StateArray:
        raised, goal = rng.integers(config.num_objects, size=num), np.empty((num, config.num_objects, 3))
        for index, body in enumerate(config.bodies):
            of_kind, lying = (_goals_of(body, each, rng, num, config, success_distance_m) for each in (kind, "table"))
            goal[:, index] = np.where((raised == index)[:, None], of_kind, lying)
        return goal.reshape(num, -1)

    return _drawn_apart(draw, num, config)


def _goals_of(
    shape: ObjectConfig,
    kind: GoalKind,
    rng: np.random.Generator,
    num: int,
    config: WorldConfig,
    success_distance_m: float,
) -> StateArray:
    """(num, 3) goals for one object."""
    rest_m = shape.extent_m[2] / 2

    def draw(num: int) -> StateArray:
        table = _on_table(rng, num, config, shape)
        if kind == "table":
            return table
        lowest = rest_m + (success_distance_m if kind == "air" else 0.0)
        volume = sample_in_volume(rng, num, config.workspace, lowest_m=lowest)
        if kind != "mixed":
            return volume
        return np.where(rng.random((num, 1)) < MIXED_AIR_SHARE, volume, table)

    return _clear_of_fixtures(draw, num, config, np.zeros(3), shape)


def _drawn_apart(draw: Callable[[int], StateArray], num: int, config: WorldConfig) -> StateArray:
    """(num, 3 K) goals, each drawn again until its objects ``are_apart``."""
    goal = draw(num)
    for _ in range(_MAX_DRAWS):
        near = ~are_apart(goal, config)
        if not near.any():
            return goal
        goal[near] = draw(int(near.sum()))
    raise ConfigError("world.objects: no room in the workspace for goals of all: make world.workspace larger")


def are_apart(goal: StateArray, config: WorldConfig) -> BoolArray:
    """(N,) whether all objects at their places of (N, 3 K) are apart: see ``apart``."""
    all_apart: BoolArray = np.all(apart(goal, config), axis=(1, 2))
    return all_apart


def apart(goal: StateArray, config: WorldConfig) -> BoolArray:
    """(N, K, K) which objects at their places of (N, 3 K) are apart, however they are turned about the vertical.

    Cubes of 5 cm are by 7 cm; what is tall has to be beside or above as well.
    """
    place, extent = each_object(goal), np.array([body.extent_m for body in config.bodies])
    way: StateArray = np.abs(place[:, :, None] - place[:, None])
    radius, half = np.hypot(extent[:, 0], extent[:, 1]) / 2, extent[:, 2] / 2
    least = np.add.outer(radius, radius)
    beside = np.hypot(way[..., 0], way[..., 1]) >= least
    clear = beside | (way[..., 2] >= np.add.outer(half, half))
    itself = np.eye(config.num_objects, dtype=bool)
    found: BoolArray = itself | (clear & (np.linalg.norm(way, axis=3) >= least))
    return found


def sample_in_volume(rng: np.random.Generator, num: int, workspace: WorkspaceConfig, *, lowest_m: float) -> StateArray:
    """(num, 3) object centres, uniform in the workspace above ``lowest_m``."""
    position = sample_on_table(rng, num, workspace, 0.0)
    position[:, 2] = rng.uniform(lowest_m, workspace.height_m, num)
    return position


def draw_goals(
    kind: GoalKind, rng: np.random.Generator, config: WorldConfig, success_distance_m: float, places: Places
) -> StateArray:
    """(N, 3 K) goals for N worlds whose things are at ``places``, metres; none is inside an obstacle's place.

    With a wall, they are on the table in the area on the other side of it than the object. With a box, in its middle,
    as high as an object on the table: one within 5 cm has its underside below the rim; one on the bottom is 5 mm too
    high. ``one``: a mixed goal for one object, and the others are to stay. Else ``sample_goals`` draws them.

    Raises:
        TandemError: goals off the table in a world with a fixture, or no room for any.
    """
    check_goals(kind, config, success_distance_m)

    def draw(places: Places) -> StateArray:
        if config.fixture == "wall":
            other_side = np.where(places.object[:, 0] < config.workspace.center_x_m, 1.0, -1.0)
            return _beside_wall(rng, other_side, config)
        if config.fixture == "box":
            in_box: StateArray = places.box + np.array([0.0, 0.0, config.rest_height_m])
            return in_box
        if kind == "one":
            return _one_moved(rng, config, success_distance_m, places.object)
        return sample_goals(kind, rng, len(places.object), config, success_distance_m)

    goal = draw(places)
    if not places.obstacles.size:
        return goal
    for _ in range(_MAX_DRAWS):
        inside = inside_obstacles(goal, places.obstacles, config)
        if not inside.any():
            return goal
        goal[inside] = draw(places.of(inside))
    raise ConfigError(
        f"world.obstacles: the {len(config.obstacles)} of them leave no place for a goal: leave some out, or make "
        "world.workspace larger"
    )


def _one_moved(
    rng: np.random.Generator, config: WorldConfig, success_distance_m: float, places: StateArray
) -> StateArray:
    """(N, 3 K) goals in which one object has a mixed goal clear of the others, which are to stay where they are."""
    num = len(places)
    worlds, moved = np.arange(num), rng.integers(config.num_objects, size=num)
    goal, near = places.copy(), np.ones(num, dtype=bool)
    place = each_object(goal)  # a view
    for _ in range(_MAX_DRAWS):
        for index, body in enumerate(config.bodies):
            here = near & (moved == index)
            place[here, index] = _goals_of(body, "mixed", rng, int(here.sum()), config, success_distance_m)
        near = ~np.all(apart(goal, config)[worlds, moved], axis=1)
        if not near.any():
            return goal
    raise ConfigError("world.objects: no room for a goal beside the others: make world.workspace larger")


def check_goals(kind: GoalKind, config: WorldConfig, success_distance_m: float = SUCCESS_DISTANCE_M) -> None:
    """Refuse goals that a world cannot have.

    Raises:
        TandemError: an unknown kind, or goals off the table in a world with a fixture.
    """
    if kind not in GOAL_KINDS:
        raise TandemError(f"goals = {kind!r}; choose one of {', '.join(GOAL_KINDS)}")
    if kind == "one" and config.num_objects == 1:
        raise TandemError("goals = 'one' are for worlds of several objects; choose mixed")
    if config.fixture != "none" and kind != "table":
        where = {"wall": "behind it", "box": "in it"}[config.fixture]
        raise TandemError(f"goals = {kind!r} with a {config.fixture}: its goals lie {where}; choose table")
    lowest_m = max(config.rest_heights_m) + success_distance_m
    if kind == "air" and lowest_m >= config.workspace.height_m:
        raise TandemError(
            f"goals = 'air' in a workspace {config.workspace.height_m:g} m high: they begin at {lowest_m:g} m; "
            "choose table"
        )
