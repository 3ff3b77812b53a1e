"""Objects by description: what lies on the table, how it rests, and that it can be held."""

import mujoco
import numpy as np
import pytest

from service.base.errors import ConfigError
from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.sampling import draw_first
from tests.envs.scripted import place_in_air
from tests.runs.runs import assert_one_line

COARSE = {"physics_step_s": 0.005, "num_substeps": 8}
"""By shape: sizes, and extent as it starts, by hand."""
SHAPES = {
    "box": ((0.06, 0.04, 0.03), (0.06, 0.04, 0.03)),
    "sphere": ((0.05,), (0.05, 0.05, 0.05)),
    "cylinder": ((0.05, 0.06), (0.05, 0.05, 0.06)),
    "capsule": ((0.04, 0.09), (0.09, 0.04, 0.04)),
    "ellipsoid": ((0.07, 0.05, 0.04), (0.07, 0.05, 0.04)),
}


def world_with(shape, **changed):
    return WorldConfig(object={"shape": shape, "size_m": SHAPES[shape][0]}, **changed)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_shape_has_its_size_where_it_starts(shape):
    world = world_with(shape)
    _, extent = SHAPES[shape]
    assert world.shape.extent_m == extent
    assert world.rest_height_m == extent[2] / 2
    with WorldBatch(world, 1) as worlds:
        geom = worlds.model.geom("object")
        assert float(worlds.model.geom_rbound[geom.id]) == pytest.approx(radius_of(shape, extent), rel=1e-6)
        inertia = worlds.model.body("object").inertia
        assert inertia.max() == pytest.approx(most_inertia(shape, extent), rel=1e-6)


def radius_of(shape, extent):
    """Of the smallest sphere around it."""
    x, y, z = np.array(extent) / 2
    return {
        "box": np.sqrt(x**2 + y**2 + z**2),
        "sphere": x,
        "cylinder": np.hypot(x, z),
        "capsule": x,
        "ellipsoid": max(x, y, z),
    }[shape]


def most_inertia(shape, extent, mass=0.1):
    """The greatest principal moment of a solid body, kg m2."""
    x, y, z = np.array(extent) / 2
    if shape == "capsule":
        length, radius = 2 * (x - z), z
        pipe, ball = np.pi * radius**2 * length, 4 / 3 * np.pi * radius**3
        pipe, ball = mass * pipe / (pipe + ball), mass * ball / (pipe + ball)
        across = pipe * (length**2 / 12 + radius**2 / 4)
        return across + ball * (2 / 5 * radius**2 + length**2 / 4 + 3 / 8 * length * radius)
    return {
        "box": mass / 3 * (x**2 + y**2),
        "sphere": 2 / 5 * mass * x**2,
        "cylinder": mass * max(x**2 / 2, x**2 / 4 + z**2 / 3),
        "ellipsoid": mass / 5 * (x**2 + y**2),
    }[shape]


@pytest.mark.parametrize("shape", SHAPES)
def test_it_lies_still_where_it_starts(shape):
    with WorldBatch(world_with(shape, **COARSE), 4) as worlds:
        worlds.reset(np.random.default_rng(0))
        before = worlds.object_position.copy()
        np.testing.assert_allclose(before[:, 2], SHAPES[shape][1][2] / 2)
        for _ in range(50):
            worlds.step(np.zeros((4, 4), dtype=np.float32))
        assert np.linalg.norm(worlds.object_position - before, axis=1).max() < 1e-3


@pytest.mark.parametrize(("shape", "least"), [("box", 0.9), ("cylinder", 0.9)])
def test_it_is_picked_up_carried_and_held(shape, least):
    placement = place_in_air(world_with(shape, **COARSE), 12, seed=0)
    held = (placement.distance_m < 0.01) & (placement.distance_after_hold_m < 0.01)
    assert held.mean() >= least


def test_a_cube_and_a_sphere_by_their_names_are_what_they_were():
    assert WorldConfig().shape.extent_m == (0.05, 0.05, 0.05)
    with WorldBatch(WorldConfig(), 1) as named, WorldBatch(world_with("sphere"), 1) as described:
        assert named.model.geom("object").type == mujoco.mjtGeom.mjGEOM_BOX
        np.testing.assert_array_equal(named.model.geom("object").size, [0.025] * 3)
        np.testing.assert_array_equal(described.model.geom("object").condim, 6)
    by_name = WorldConfig(object="sphere", object_size_m=0.05)
    assert by_name.shape == world_with("sphere").shape
    assert by_name != world_with("sphere")  # a recorded configuration stays as it was written


@pytest.mark.parametrize("fixture", ["wall", "box"])
def test_a_long_object_starts_clear_of_a_fixture(fixture):
    world = WorldConfig(object={"shape": "box", "size_m": (0.12, 0.03, 0.03)}, fixture=fixture)
    position, box, _ = draw_first(np.random.default_rng(0), 2000, world)
    if fixture == "wall":
        assert np.abs(position[:, 0] - world.workspace.center_x_m).min() >= 0.06 + 0.005 + 0.005
    else:
        away = np.abs(position - box)[:, :2]
        assert ((away[:, 0] >= 0.05 + 0.06 + 0.005) | (away[:, 1] >= 0.05 + 0.015 + 0.04)).all()


class Counted:
    """Random numbers for a while."""

    def __init__(self, num):
        self._rng, self._left = np.random.default_rng(0), num

    def uniform(self, *given):
        self._left -= 1
        assert self._left >= 0, "it draws for ever"
        return self._rng.uniform(*given)


def test_a_workspace_in_which_most_places_of_the_box_leave_no_room():
    world = WorldConfig(fixture="box", workspace={"length_x_m": 0.12, "length_y_m": 0.15})
    position, box, _ = draw_first(Counted(5000), 200, world)
    away = np.abs(position - box)[:, :2]
    assert ((away[:, 0] >= 0.05 + 0.025 + 0.005) | (away[:, 1] >= 0.05 + 0.025 + 0.04)).all()
    for place in (position, box):
        assert (np.abs(place[:, :2] - [-0.05, 0.0]) <= [0.06, 0.075]).all()
    world = WorldConfig(fixture="box", workspace={"length_x_m": 0.07, "length_y_m": 0.11})
    with pytest.raises(ConfigError) as error:
        draw_first(Counted(5000), 1, world)
    assert_one_line(error.value, "no room in the workspace for the object beside the box", "world.workspace larger")


def test_an_object_wider_than_the_gripper_opens():
    with pytest.raises(ConfigError) as error:
        WorldBatch(WorldConfig(object={"shape": "box", "size_m": (0.05, 0.09, 0.05)}), 1)
    assert_one_line(error.value, "opens to 0.08 m", "0.09 m wide", "turn it")
    WorldBatch(WorldConfig(object={"shape": "box", "size_m": (0.09, 0.05, 0.05)}), 1).close()
    WorldBatch(WorldConfig(object={"shape": "box", "size_m": (0.05, 0.09, 0.05)}, gripper="blocked"), 1).close()
