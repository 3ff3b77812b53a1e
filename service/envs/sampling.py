"""Random starts of objects and boxes, and random goals, for self-play, evaluation and the Gymnasium environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from service.base.errors import ConfigError, TandemError
from service.base.types import StateArray
from service.config import WorkspaceConfig, WorldConfig
from service.envs import scene

GoalKind = Literal["table", "air", "mixed", "volume"]
GOAL_KINDS: tuple[GoalKind, ...] = ("table", "air", "mixed", "volume")

_MAX_DRAWS = 1000
MIXED_AIR_SHARE = 0.7
"""Share of mixed goals drawn anywhere in the workspace's volume; the rest lie on the table (paper: p = 0.7)."""


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


def sample_in_volume(
    rng: np.random.Generator, num: int, workspace: WorkspaceConfig, object_height_m: float, *, lowest_m: float
) -> StateArray:
    """(num, 3) object centres, uniform in the workspace above ``lowest_m``."""
    position = sample_on_table(rng, num, workspace, object_height_m)
    position[:, 2] = rng.uniform(lowest_m, workspace.height_m, num)
    return position


def draw_starts(rng: np.random.Generator, num: int, config: WorldConfig) -> tuple[StateArray, StateArray]:
    """Random starts of objects, and of the box where there is one.

    Without a fixture, anywhere on the table inside the workspace; so far from fixtures that are described that an open
    finger fits between. Beside a wall, in one of its two areas, either with equal chance. With a box, the box's middle
    is anywhere in the workspace, and the object outside of it: as far as from other fixtures.

    Returns:
        (num, 3) object centres and (num, 3) places of the box, metres; (num, 0) places in worlds without.
    """
    if config.fixture == "wall":
        return _beside_wall(rng, rng.choice((-1.0, 1.0), num), config), np.empty((num, 0))
    gap_m = (scene.GAP_M, scene.FINGER_GAP_M, scene.GAP_M)
    anywhere = clear_of_fixtures(
        lambda num: sample_on_table(rng, num, config.workspace, 2 * config.rest_height_m), num, config, gap_m
    )
    if config.fixture == "box":
        place = anywhere * (1.0, 1.0, 0.0)
        return _outside_boxes(rng, place, config), place
    return anywhere, np.empty((num, 0))


def sample_goals(
    kind: GoalKind, rng: np.random.Generator, num: int, config: WorldConfig, success_distance_m: float
) -> StateArray:
    """(num, 3) goals, metres.

    ``table``: on it. ``air``: out of reach of an object that rests on the table. ``volume``: anywhere in the workspace
    (p = 1 in the paper's words). ``mixed``: as most of the paper's downstream tasks, anywhere in the volume with
    probability 0.7, else on the table. None is where the object would be inside a fixture.
    """
    return clear_of_fixtures(lambda num: _draw_goals(kind, rng, num, config, success_distance_m), num, config)


def _draw_goals(
    kind: GoalKind, rng: np.random.Generator, num: int, config: WorldConfig, success_distance_m: float
) -> StateArray:
    table = sample_on_table(rng, num, config.workspace, 2 * config.rest_height_m)
    if kind == "table":
        return table
    lowest = config.rest_height_m + (success_distance_m if kind == "air" else 0.0)
    volume = sample_in_volume(rng, num, config.workspace, 2 * config.rest_height_m, lowest_m=lowest)
    if kind != "mixed":
        return volume
    return np.where(rng.random((num, 1)) < MIXED_AIR_SHARE, volume, table)


def draw_goals(
    kind: GoalKind,
    rng: np.random.Generator,
    config: WorldConfig,
    success_distance_m: float,
    *,
    start: StateArray,
    box: StateArray,
) -> StateArray:
    """(num, 3) goals for worlds whose (num, 3) objects and boxes are at ``start`` and ``box``, metres.

    With a wall, they are on the table in the area on the other side of it than the object. With a box, in its middle,
    as high as an object on the table: one within 5 cm has its underside below the rim; one on the bottom is 5 mm too
    high. Else ``sample_goals`` draws them, and ``box`` is (num, 0).

    Raises:
        TandemError: goals off the table in a world with a fixture.
    """
    check_goals(kind, config)
    if config.fixture == "wall":
        return _beside_wall(rng, np.where(start[:, 0] < config.workspace.center_x_m, 1.0, -1.0), config)
    if config.fixture == "box":
        in_box: StateArray = box + np.array([0.0, 0.0, config.rest_height_m])
        return in_box
    return sample_goals(kind, rng, len(start), config, success_distance_m)


def check_goals(kind: GoalKind, config: WorldConfig) -> None:
    """Refuse goals that a world cannot have.

    Raises:
        TandemError: an unknown kind, or goals off the table in a world with a fixture.
    """
    if kind not in GOAL_KINDS:
        raise TandemError(f"goals = {kind!r}; choose one of {', '.join(GOAL_KINDS)}")
    if config.fixture != "none" and kind != "table":
        where = {"wall": "behind it", "box": "in it"}[config.fixture]
        raise TandemError(f"goals = {kind!r} with a {config.fixture}: its goals lie {where}; choose table")


def clear_of_fixtures(
    draw: Callable[[int], StateArray], num: int, config: WorldConfig, gap_m: Sequence[float] = (0.0, 0.0, 0.0)
) -> StateArray:
    """(num, 3) object centres, each drawn again until the object is clear of all described fixtures."""
    position = draw(num)
    half = np.array(config.shape.extent_m) / 2 + gap_m
    boxes = [(np.array(each.lower_m) - half, np.array(each.upper_m) + half) for each in config.fixtures]
    for _ in range(_MAX_DRAWS if boxes else 0):
        inside = np.any([((position > low) & (position < high)).all(axis=1) for low, high in boxes], axis=0)
        if not inside.any():
            return position
        position[inside] = draw(int(inside.sum()))
    if boxes:
        raise ConfigError(
            f"world.fixtures: the {len(boxes)} of them leave no room for the object in the workspace: take some away, "
            "or make world.workspace larger"
        )
    return position


def _beside_wall(rng: np.random.Generator, side: StateArray, config: WorldConfig) -> StateArray:
    """(num, 3) object centres in the area on each (num,) side: -1 is nearer to the robot, 1 farther."""
    position = sample_on_table(rng, len(side), config.workspace, 2 * config.rest_height_m)
    nearest = scene.WALL_THICKNESS_M / 2 + scene.GAP_M + config.shape.extent_m[0] / 2
    distance = nearest + rng.uniform(0.0, scene.AREA_LENGTH_M, len(side))
    position[:, 0] = config.workspace.center_x_m + side * distance
    return position


def _outside_boxes(rng: np.random.Generator, place: StateArray, config: WorldConfig) -> StateArray:
    """(num, 3) object centres in the workspace, each drawn again until it is clear of its box."""
    apart = scene.BOX_SIZE_M / 2 + np.array(config.shape.extent_m[:2]) / 2
    least = apart + np.array([scene.GAP_M, scene.FINGER_GAP_M])
    position = sample_on_table(rng, len(place), config.workspace, 2 * config.rest_height_m)
    while (inside := (np.abs(position - place)[:, :2] < least).all(axis=1)).any():
        position[inside] = sample_on_table(rng, int(inside.sum()), config.workspace, 2 * config.rest_height_m)
    return position
