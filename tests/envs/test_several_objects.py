"""Worlds of several objects that each have a goal: where they start, what is seen of them, and their goals."""

from itertools import combinations

import numpy as np
import pytest
from pydantic import ValidationError

from service.base.errors import ConfigError
from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.observations import distances, each_object, layouts
from service.envs.overlap import inside_fixtures
from service.envs.rules import Rules
from service.envs.sampling import GOAL_KINDS, are_apart, draw_goals, sample_goals
from service.envs.task import Task
from tests.envs.scripted import CLOSE, OPEN, drive
from tests.envs.test_obstacles import put, touching

CYLINDER = {"shape": "cylinder", "size_m": (0.04, 0.06), "mass_kg": 0.2, "friction": 0.8}
FAST = {"physics_step_s": 0.004, "num_substeps": 10}
CUBES, MIXED = WorldConfig(objects=("cube", "cube"), **FAST), WorldConfig(objects=("cube", CYLINDER), **FAST)
RED, BLUE = np.array([-0.1, 0.05, 0.025]), np.array([0.05, -0.1, 0.025])


@pytest.fixture
def worlds():
    with WorldBatch(CUBES, 1, num_threads=1) as made:
        put(made, object=RED, object_2=BLUE)
        yield made


@pytest.mark.parametrize(
    ("only", "same"),
    [
        ("cube", {}),
        ("sphere", {"object": "sphere"}),
        (
            CYLINDER,
            {"object": {"shape": "cylinder", "size_m": (0.04, 0.06)}, "object_mass_kg": 0.2, "friction": 0.8},
        ),
    ],
)
def test_a_list_of_one_is_the_world_of_one_object(only, same):
    assert WorldConfig(objects=[only]) == WorldConfig(**same)


def test_what_is_named_has_the_worlds_size_mass_and_friction_and_a_color_of_its_own():
    assert WorldConfig(objects=({**CYLINDER, "mass_kg": 3.0},)).object_mass_kg == 3.0  # as much as beside others
    world = WorldConfig(objects=("cube", CYLINDER, "sphere"), object_size_m=0.04, object_mass_kg=0.3, friction=0.5)
    cube, cylinder, sphere = world.bodies
    assert (cube.extent_m, cube.mass_kg, cube.friction) == ((0.04,) * 3, 0.3, 0.5)
    assert (cylinder.extent_m, cylinder.mass_kg, cylinder.friction) == ((0.04, 0.04, 0.06), 0.2, 0.8)
    assert sphere.shape == "sphere"
    assert len({cube.color, cylinder.color, sphere.color}) == 3
    assert world.rest_heights_m == (0.02, 0.03, 0.02)
    can = {"shape": "cylinder", "size_m": (0.04, 0.06)}  # of what it does not say as well
    world = WorldConfig(objects=(can, can, {**can, "friction": 0.8}), object_mass_kg=0.3, friction=0.5)
    assert [(each.mass_kg, each.friction) for each in world.bodies] == [(0.3, 0.5), (0.3, 0.5), (0.3, 0.8)]
    assert [each.color for each in world.bodies] == [each.color for each in WorldConfig(objects=["cube"] * 3).bodies]
    assert WorldConfig.model_validate(world.model_dump()) == world
    assert WorldConfig(objects=world.bodies).bodies == world.bodies
    assert WorldConfig(objects=({**can, "mass_kg": None},)).object_mass_kg == 0.1
    harder = WorldConfig.model_validate(world.model_dump() | {"object_mass_kg": 1.0, "friction": 0.25})  # as of a task
    assert [(each.mass_kg, each.friction) for each in harder.bodies] == [(1.0, 0.25), (1.0, 0.25), (1.0, 0.8)]


@pytest.mark.parametrize("config", [CUBES, MIXED, WorldConfig(objects=("cube", "cube", CYLINDER), **FAST)])
def test_they_start_clear_of_each_other_with_room_for_a_finger(config):
    with WorldBatch(config, 200) as worlds:
        assert touching(worlds) == set()
        worlds.reset(np.random.default_rng(0))
        assert touching(worlds) == set()
        place = each_object(worlds.object_position)
        num = config.num_objects
        np.testing.assert_allclose(place[:, :, 2], np.broadcast_to(config.rest_heights_m, (200, num)))
        widths = np.array([body.extent_m[1] for body in config.bodies])
        for one, other in combinations(range(num), 2):
            beside = np.abs(place[:, one] - place[:, other])
            in_line = beside[:, 0] < 0.04  # along x: then a finger has to fit between them along y
            assert in_line.any()
            assert (beside[in_line, 1] >= (widths[one] + widths[other]) / 2 + 0.04 - 1e-9).all()


def test_a_finger_fits_between_each_and_a_fixture():
    fixture = {"shape": "box", "size_m": (0.3, 0.06, 0.04), "position_m": (-0.05, 0.0)}
    with WorldBatch(WorldConfig(objects=("cube", "cube"), fixtures=[fixture], **FAST), 300) as worlds:
        worlds.reset(np.random.default_rng(0))
        place = each_object(worlds.object_position)
    in_line = np.abs(place[:, :, 0] + 0.05) < 0.15 + 0.02
    for number in range(2):
        away = np.abs(place[in_line[:, number], number, 1]) - 0.03 - 0.025
        assert 0.04 - 1e-9 <= away.min() < 0.05


def test_observations_have_as_much_of_each(worlds):
    seen = worlds.observed
    assert (seen.positions.size, seen.bob.size, seen.full.size, seen.bob_value.size) == (17, 23, 33, 44)
    positions = worlds.positions()[0]
    np.testing.assert_allclose(positions[seen.positions["object"]], [*RED, *BLUE], atol=1e-6)
    from_effector = [*(RED - worlds.ee_position[0]), *(BLUE - worlds.ee_position[0])]
    np.testing.assert_allclose(positions[seen.positions["object_from_effector"]], from_effector, atol=1e-6)
    goal = np.array([[*BLUE, *RED]])
    way = worlds.bob_value(goal)[0][seen.bob_value["goal_from_object"]]
    np.testing.assert_allclose(way, [*(BLUE - RED), *(RED - BLUE)], atol=1e-6)


def test_a_finger_touches_the_object_that_it_touches(worlds):
    for grip, height_m, num_steps in ((OPEN, 0.1, 12), (OPEN, 0.022, 8), (CLOSE, 0.022, 4)):
        for _ in drive(worlds, lambda height_m=height_m: np.array([[*BLUE[:2], height_m]]), grip, num_steps):
            pass
    assert worlds.contacts().tolist() == [[False, False, True, True]]
    contacts = worlds.full(0.5)[0][worlds.observed.full["contacts"]]
    assert contacts.tolist() == [0.0, 0.0, 1.0, 1.0]
    for _ in drive(worlds, lambda: np.array([[*BLUE[:2], 0.15]]), CLOSE, 8):
        pass
    red, blue = each_object(worlds.object_position)[0]
    np.testing.assert_allclose(red, RED, atol=2e-3)
    assert blue[2] > 0.1
    assert each_object(worlds.object_velocity).shape == (1, 2, 3)


def test_one_rests_on_the_other(worlds):
    put(worlds, object=np.add(BLUE, [0.0, 0.0, 0.05]))
    for _ in range(50):
        worlds.step(np.zeros((1, 4), dtype=np.float32))
    red, blue = each_object(worlds.object_position)[0]
    np.testing.assert_allclose(red - blue, [0.0, 0.0, 0.05], atol=2e-3)


def test_columns_of_objects_that_are_alike_by_hand():
    cylinder = {"shape": "cylinder", "size_m": [0.05, 0.05]}
    seen = layouts(WorldConfig(objects=("cube", cylinder, "cube")))
    # effector 3, fingers 2, objects 9, their ways from the effector 9, goals 9
    assert seen.bob.normalisation.by_object.tolist() == [
        [14, 15, 16, 5, 6, 7, 23, 24, 25],
        [20, 21, 22, 11, 12, 13, 29, 30, 31],
    ]
    assert seen.full.normalisation.by_object.shape == (2, 3 + 3 + 3 + 2)
    assert layouts(WorldConfig(objects=("cube", cylinder))).bob.normalisation.by_object is None
    assert layouts(WorldConfig()).bob.normalisation.by_object is None


def test_a_reflection_keeps_the_objects_apart(worlds):
    layout = worlds.observed.positions
    reflected = layout.mirror(worlds.positions()[0])
    np.testing.assert_allclose(reflected[layout["object"]], [*(RED * [1, -1, 1]), *(BLUE * [1, -1, 1])], atol=1e-6)


@pytest.mark.parametrize("config", [CUBES, MIXED, WorldConfig(objects=("cube",) * 4, **FAST)])
@pytest.mark.parametrize("kind", GOAL_KINDS)
def test_goals_are_apart_and_at_most_one_is_in_the_air(config, kind):
    with WorldBatch(config, 300, num_threads=1) as worlds:
        worlds.reset(np.random.default_rng(0))
        goal = draw_goals(kind, np.random.default_rng(1), config, 0.05, worlds.places)
        starts = worlds.object_position.copy()
    place, rest = each_object(goal), np.array(config.rest_heights_m)
    if kind != "one":  # what stays may lie nearer
        assert are_apart(goal, config).all()
    raised = place[:, :, 2] > rest + 1e-9
    assert raised.sum(axis=1).max() <= 1
    if kind == "table":
        assert not raised.any()
    if kind == "air":
        assert raised.any(axis=1).all()
        assert (place[:, :, 2] - rest)[raised].min() >= 0.05
        assert abs(raised[:, 0].mean() - 1 / config.num_objects) < 0.1
    moved = distances(goal, starts) > 1e-9
    assert (moved.sum(axis=1) == 1).all() if kind == "one" else moved.all()
    if kind == "one":
        assert 0.6 < raised.any(axis=1).mean() < 0.9
        of_moved = place[moved]
        beside = np.linalg.norm(place - of_moved[:, None], axis=2) < 0.05
        assert (beside.sum(axis=1) == 1).all()


def test_goals_in_a_row_of_fixtures_are_clear_of_them():
    post = {"shape": "box", "size_m": (0.05, 0.3, 0.1), "position_m": (-0.05, 0.0)}
    config = MIXED.model_copy(update={"fixtures": WorldConfig(fixtures=(post,)).fixtures, "start_height_m": 0.2})
    goal = sample_goals("mixed", np.random.default_rng(0), 300, config, 0.05)
    assert not inside_fixtures(goal, config).any()
    inside, clear = (-0.05, 0.1, 0.025), (0.1, 0.0, 0.025)
    assert inside_fixtures(np.array([[*inside, *clear], [*clear, *inside]]), config).all()


def test_success_and_what_a_task_sees(worlds):
    goal = np.array([[*RED, *np.add(BLUE, [0.04, 0.0, 0.0])]])
    assert Rules("mixed", worlds).solved(goal).tolist() == [True]
    assert Rules("mixed", worlds).solved(np.add(goal, [0.0, 0.0, 0.0, 0.02, 0.0, 0.0])).tolist() == [False]
    view = Rules(Task("Two", success=lambda view: view.goal[:, 1, 0] > 0), worlds).view(goal)
    assert (view.objects.place.shape, view.goal.shape, view.contacts.shape) == ((1, 2, 3), (1, 2, 3), (1, 2, 2))
    np.testing.assert_allclose(view.objects.place[0], [RED, BLUE])
    again = view.of_rows(view.rows(), each_object(goal))
    np.testing.assert_allclose(again.objects.place, view.objects.place, atol=1e-6)
    np.testing.assert_allclose(again.objects.velocity, view.objects.velocity, atol=1e-6)


@pytest.mark.parametrize(
    ("world", "said"),
    [
        ({"object": "sphere", "objects": ["cube", "cube"]}, "object = 'sphere' and objects"),
        ({"object": "sphere", "objects": ["cube"]}, "object = 'sphere' and objects: a world has the one or the other"),
        ({"objects": ["cube", "cube"], "fixture": "wall"}, "fixture = 'wall' and 2 objects: it is for one"),
        ({"objects": ["cube", "pyramid"]}, "cube"),
        ({"objects": ["cube"] * 5}, "at most 4"),
    ],
)
def test_worlds_that_do_not_go_together(world, said):
    with pytest.raises(ValidationError, match=said):
        WorldConfig(**world)


def test_objects_that_do_not_fit_on_the_table_are_refused():
    board = {"shape": "box", "size_m": (0.3, 0.06, 0.04)}
    small = {"length_x_m": 0.1, "length_y_m": 0.1}
    with pytest.raises(ConfigError, match=r"world\.workspace: no room in it for 4 objects beside each other"):
        WorldBatch(WorldConfig(objects=("cube", board, board, board), workspace=small), 1)


@pytest.mark.parametrize(("friction", "way_m"), [(0.1, 0.183), (0.3, 0.061), (1.0, 0.018)])
def test_an_object_slides_as_far_as_its_friction_says(friction, way_m):
    """v^2 / (2 mu g) from 0.6 m/s, though the table has a friction of 1."""
    slippery = {"shape": "box", "size_m": (0.05, 0.05, 0.05), "friction": friction}
    with WorldBatch(WorldConfig(objects=("cube", slippery), **FAST), 1, num_threads=1) as worlds:
        put(worlds, object=[-0.15, -0.15, 0.025], object_2=[0.0, 0.12, 0.025])
        worlds.states[:, worlds.layout["object_2_velocity"]] = [-0.6, 0.0, 0.0]
        worlds.restore(worlds.states.copy())
        before = worlds.object_position.copy()
        for _ in range(20):
            worlds.step(np.zeros((1, 4), dtype=np.float32))
        slid = np.linalg.norm((worlds.object_position - before)[0, 3:])
    assert slid == pytest.approx(way_m, rel=0.15)


def test_nothing_has_its_goal_inside_something_tall():
    tall = WorldConfig(objects=("cube", {"shape": "box", "size_m": (0.04, 0.04, 0.2)}), **FAST)
    goal = each_object(sample_goals("mixed", np.random.default_rng(0), 5000, tall, 0.05))
    way = np.abs(goal[:, 0] - goal[:, 1])
    beside = np.hypot(way[:, 0], way[:, 1]) >= 0.05 / 2**0.5 + 0.04 / 2**0.5
    assert (beside | (way[:, 2] >= 0.125)).all()
    assert (~beside).any()
