"""Random positions of objects and goals, and of objects beside a wall or a box."""

from __future__ import annotations

import numpy as np

from service.config import WorkspaceConfig, WorldConfig
from service.envs import fixtures
from service.types import StateArray

_TABLE_TOP_M = 0.0


def sample_on_table(rng: np.random.Generator, num: int, workspace: WorkspaceConfig, object_size_m: float) -> StateArray:
    """(num, 3) object centres, uniform over the workspace's table area, resting on the table."""
    center = np.array([workspace.center_x_m, workspace.center_y_m])
    half = np.array([workspace.length_x_m, workspace.length_y_m]) / 2
    position = np.empty((num, 3))
    position[:, :2] = center + rng.uniform(-half, half, (num, 2))
    position[:, 2] = _TABLE_TOP_M + object_size_m / 2
    return position


def sample_in_volume(
    rng: np.random.Generator,
    num: int,
    workspace: WorkspaceConfig,
    object_size_m: float,
    *,
    lowest_m: float | None = None,
) -> StateArray:
    """(num, 3) object centres, uniform in the workspace above ``lowest_m`` (default: resting height)."""
    position = sample_on_table(rng, num, workspace, object_size_m)
    low = _TABLE_TOP_M + object_size_m / 2 if lowest_m is None else lowest_m
    position[:, 2] = rng.uniform(low, workspace.height_m, num)
    return position


def draw_starts(rng: np.random.Generator, num: int, config: WorldConfig) -> tuple[StateArray, StateArray]:
    """Random starts of objects, and of the box where there is one.

    Without a fixture, anywhere on the table inside the workspace. Beside a wall, in one of its two areas, either with
    equal chance. With a box, the box's middle is anywhere in the workspace, and the object outside of it: so far that
    an open finger fits between the two.

    Returns:
        (num, 3) object centres and (num, 3) places of the box, metres; (num, 0) places in worlds without.
    """
    if config.fixture == "wall":
        return _beside_wall(rng, rng.choice((-1.0, 1.0), num), config), np.empty((num, 0))
    anywhere = sample_on_table(rng, num, config.workspace, config.object_size_m)
    if config.fixture == "box":
        place = anywhere * (1.0, 1.0, 0.0)
        return _outside_boxes(rng, place, config), place
    return anywhere, np.empty((num, 0))


def behind_wall(rng: np.random.Generator, start: StateArray, config: WorldConfig) -> StateArray:
    """(num, 3) goals on the table, in the area on the other side of the wall than the (num, 3) objects' start."""
    return _beside_wall(rng, np.where(start[:, 0] < config.workspace.center_x_m, 1.0, -1.0), config)


def in_box(place: StateArray, config: WorldConfig) -> StateArray:
    """(num, 3) goals in the middle of boxes at (num, 3) places, as high as an object on the table.

    An object within 5 cm, the height of a box, has its underside below the rim; one on the bottom is 5 mm too high.
    """
    goal: StateArray = place + np.array([0.0, 0.0, config.object_size_m / 2])
    return goal


def _beside_wall(rng: np.random.Generator, side: StateArray, config: WorldConfig) -> StateArray:
    """(num, 3) object centres in the area on each (num,) side: -1 is nearer to the robot, 1 farther."""
    position = sample_on_table(rng, len(side), config.workspace, config.object_size_m)
    nearest = fixtures.WALL_THICKNESS_M / 2 + fixtures.GAP_M + config.object_size_m / 2
    distance = nearest + rng.uniform(0.0, fixtures.AREA_LENGTH_M, len(side))
    position[:, 0] = config.workspace.center_x_m + side * distance
    return position


def _outside_boxes(rng: np.random.Generator, place: StateArray, config: WorldConfig) -> StateArray:
    """(num, 3) object centres in the workspace, each drawn again until it is clear of its box."""
    apart = fixtures.BOX_SIZE_M / 2 + config.object_size_m / 2
    least = np.array([apart + fixtures.GAP_M, apart + fixtures.FINGER_GAP_M])
    position = sample_on_table(rng, len(place), config.workspace, config.object_size_m)
    while (inside := (np.abs(position - place)[:, :2] < least).all(axis=1)).any():
        position[inside] = sample_on_table(rng, int(inside.sum()), config.workspace, config.object_size_m)
    return position
