"""Obstacles: further objects that lie about, elsewhere at every start, are pushed, and are seen when asked for."""

import mujoco
import numpy as np
import pytest

from service.base.errors import ConfigError
from service.config import WorldConfig
from service.envs.batch import SEEN_WITHIN_M, WorldBatch
from service.envs.objects import FLOOR_Z_M
from service.envs.observations import POSITIONS, layouts
from service.envs.sampling import draw_goals
from service.generator.generator import TaskGenerator
from tests.envs.robots import write_robot
from tests.envs.scripted import CLOSE, drive
from tests.runs.runs import assert_one_line, play, tiny_config

BLOCK = {"shape": "box", "size_m": (0.06, 0.04, 0.05), "mass_kg": 0.2}
BALL = {"shape": "sphere", "size_m": (0.05,)}
BOTTLE = {"shape": "cylinder", "size_m": (0.04, 0.16), "mass_kg": 0.3}
POST = {"shape": "cylinder", "size_m": (0.04, 0.2), "position_m": (0.08, -0.1)}
SEEN = {"obstacles": True}
SIDES = ("length_x_m", "length_y_m", "height_m")
WORLD = WorldConfig(obstacles=[BLOCK, BALL, BOTTLE], observed=SEEN, physics_step_s=0.004, num_substeps=10)
STAY = np.zeros((1, 4), dtype=np.float32)


def put(worlds, **places):
    """Every world's things at the named places, at rest."""
    states = worlds.states.copy()
    for name, place in places.items():
        states[:, worlds.layout[name]] = place
    worlds.restore(states)


def touching(worlds):
    """Pairs of geoms, but for those with the table, that overlap in some world, by MuJoCo itself."""
    found, data = set(), mujoco.MjData(worlds.model)
    for state in worlds.states:
        physics = state[worlds.layout.physics]
        mujoco.mj_setState(worlds.model, data, physics, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        if worlds.model.nmocap:
            data.mocap_pos[0] = state[worlds.layout["box_place"]]
        mujoco.mj_forward(worlds.model, data)
        for contact in data.contact[: data.ncon]:
            names = {worlds.model.geom(int(geom)).name for geom in contact.geom}
            if "table" not in names and contact.dist < 0.0:
                found.add(frozenset(names))
    return found


@pytest.mark.parametrize("more", [{}, {"fixtures": [POST]}, {"fixture": "box"}, {"fixture": "wall"}])
def test_they_start_inside_the_workspace_and_clear_of_everything(more):
    config = WORLD.model_copy(update=dict(WorldConfig(**more)) | {"obstacles": WORLD.obstacles})
    with WorldBatch(config, 200) as worlds:
        assert touching(worlds) == set()  # before the first reset
        worlds.reset(np.random.default_rng(0))
        assert touching(worlds) == set()
        places = worlds.obstacle_positions
        np.testing.assert_allclose(places[:, :, 2], np.broadcast_to([0.025, 0.025, 0.08], (200, 3)))
        lower, upper = np.array(config.workspace.lower_m)[:2], np.array(config.workspace.upper_m)[:2]
        assert ((places[:, :, :2] >= lower) & (places[:, :, :2] <= upper)).all()
        assert np.ptp(places[:, 0, :2], axis=0).min() > 0.3  # all over it
        away = np.abs(places - worlds.object_position[:, None])[:, :, :2]
        half = np.array([[0.03, 0.02], [0.025, 0.025], [0.02, 0.02]]) + 0.025
        assert (away >= half + np.array([0.005, 0.04]) - 1e-9).any(axis=2).all()  # an open finger fits between


def test_on_a_table_of_another_height_they_lie_on_it_and_clear_of_the_gripper():
    world = WorldConfig(obstacles=[BLOCK], randomisation={"table_height_m": (0.0, 0.03)})
    with WorldBatch(world, 50) as worlds:
        worlds.reset(np.random.default_rng(0))
        height = worlds.obstacle_positions[:, 0, 2].copy()
        assert np.ptp(height) > 0.02
        for _ in range(10):
            worlds.step(np.zeros((50, 4), dtype=np.float32))
        np.testing.assert_allclose(worlds.obstacle_positions[:, 0, 2], height, atol=1e-3)


def test_worlds_without_any_are_as_they_were():
    with WorldBatch(WorldConfig(), 50) as worlds:
        drawn = worlds.draw_starts(np.random.default_rng(3), 50)[:, worlds.layout["object"]]
        rng = np.random.default_rng(3)
        np.testing.assert_array_equal(drawn[:, :2], np.array([-0.05, 0.0]) + rng.uniform(-0.175, 0.175, (50, 2)))
        assert worlds.layout.size == 34
        assert mujoco.mj_name2id(worlds.model, mujoco.mjtObj.mjOBJ_GEOM, "ground") == -1


def test_gripper_and_object_push_them_and_a_restored_world_goes_on_bit_for_bit():
    with WorldBatch(WORLD, 1) as worlds:
        worlds.reset(np.random.default_rng(0))
        put(worlds, object=(0.02, 0.0, 0.025), obstacle_1=(0.085, 0.0, 0.025), obstacle_2=(-0.05, 0.15, 0.025))
        put(worlds, obstacle_3=(-0.2, -0.15, 0.08))
        for _ in drive(worlds, lambda: np.array([[-0.05, 0.0, 0.02]]), CLOSE, 8):
            pass
        saved, paths = worlds.states.copy(), []
        for _ in range(2):
            worlds.restore(saved)
            steps = drive(worlds, lambda: np.array([[0.06, 0.0, 0.02]]), CLOSE, 10)
            paths.append(np.concatenate([worlds.states.copy() for _ in steps]))
        np.testing.assert_array_equal(*paths)
        moved = worlds.obstacle_positions[0, :, 0] - [0.085, -0.05, -0.2]
        assert moved[0] > 0.02  # gripper, object, obstacle in a row
        assert np.abs(moved[1:]).max() < 1e-3


def test_their_weight_and_their_own_friction():
    """On a table that is rough, what slides with 0.5 m/s and friction f comes v^2 / 2 f g far."""
    slippery = {**BLOCK, "friction": 0.2}
    with WorldBatch(WorldConfig(obstacles=[slippery, {**BLOCK, "friction": 0.6}]), 1) as worlds:
        put(worlds, object=(-0.2, 0.0, 0.025), obstacle_1=(0.0, 0.2, 0.025), obstacle_2=(0.0, -0.2, 0.025))
        put(worlds, obstacle_1_velocity=(0.5, 0.0, 0.0), obstacle_2_velocity=(0.5, 0.0, 0.0))
        for _ in range(25):
            worlds.step(STAY)
        far = worlds.obstacle_positions[0, :, 0]
        np.testing.assert_allclose(far, 0.5**2 / (2 * np.array([0.2, 0.6]) * 9.81), rtol=0.1)


def test_one_that_falls_off_the_table_lies_on_the_floor_and_is_seen_at_the_bound():
    with WorldBatch(WORLD, 1) as worlds:
        worlds.reset(np.random.default_rng(0))
        put(worlds, obstacle_1=(1.5, 0.0, 0.1))
        for _ in range(50):
            worlds.step(STAY)
        assert worlds.diverged == []
        np.testing.assert_allclose(worlds.obstacle_positions[0, 0], (1.5, 0.0, FLOOR_Z_M + 0.025), atol=2e-3)
        seen = worlds.positions()[0, worlds.observed.positions["obstacle_1"]]
        np.testing.assert_allclose(seen, (SEEN_WITHIN_M, 0.0, FLOOR_Z_M + 0.025), atol=2e-3)


def test_positions_of_obstacles_follow_those_of_the_paper():
    world = WORLD.model_copy(update={"observed": WORLD.observed.model_copy(update={"num_commands": 1})})
    seen, first = layouts(world), POSITIONS.size
    assert [entry.name for entry in seen.positions.entries[4:]] == [
        "obstacle_1", "obstacle_2", "obstacle_3", "command_1"
    ]  # fmt: skip
    assert seen.bob["goal"] == slice(first + 13, first + 16)
    for layout in (seen.positions, seen.full, seen.bob, seen.bob_value, seen.gate):
        vector = np.arange(layout.size, dtype=np.float32)
        mirrored = vector[first : first + 9] * np.tile([1, -1, 1], 3)
        np.testing.assert_array_equal(layout.mirror(vector)[first : first + 9], mirrored)
        for part in (layout.normalisation.offset, layout.normalisation.scale):
            np.testing.assert_array_equal(part[first : first + 9], np.tile(part[layout["object"]], 3))
    with WorldBatch(world, 4) as worlds:
        worlds.reset(np.random.default_rng(0))
        vector = worlds.positions()
        np.testing.assert_array_equal(vector[:, first : first + 9], np.float32(worlds.obstacle_positions.reshape(4, 9)))
    blind = WORLD.model_copy(update={"observed": WorldConfig().observed})
    assert layouts(blind).positions.size == first


@pytest.mark.parametrize("kind", ["table", "volume"])
def test_no_goal_is_inside_one(kind):
    with WorldBatch(WORLD, 2000) as worlds:
        worlds.reset(np.random.default_rng(0))
        places = worlds.places
    goal = draw_goals(kind, np.random.default_rng(1), WORLD, 0.05, places)
    half = np.array([[0.03, 0.02, 0.025], [0.025, 0.025, 0.025], [0.02, 0.02, 0.08]]) + 0.025
    away = np.abs(goal[:, None] - places.obstacles)
    assert not (away < half).all(axis=2).any()
    assert (away < half + 0.02).all(axis=2).any()
    free = draw_goals(
        kind, np.random.default_rng(1), WorldConfig(), 0.05, places._replace(obstacles=np.empty((2000, 0, 3)))
    )
    assert (free == goal).all(axis=1).mean() > 0.5  # those that were clear stay


def test_no_goal_that_is_replayed_from_a_reset_is_inside_one():
    tree = tiny_config().model_dump()
    tree["world"] = WORLD.model_dump()
    config = type(tiny_config()).model_validate(tree)
    with WorldBatch(config.world, 2) as worlds:
        worlds.reset(np.random.default_rng(0))
        snapshot = TaskGenerator(config, worlds.layout).snapshot()
        put(worlds, object=(-0.2, 0.0, 0.025), obstacle_1=(0.0, 0.1, 0.025))
        goals = np.array([[0.01, 0.1, 0.03], [0.0, 0.0, 0.2]])
        found = snapshot._is_task(goals, worlds.states, worlds.object_position)
    assert found.tolist() == [False, True]


@pytest.mark.parametrize(
    ("world", "said"),
    [
        (
            {"obstacles": [{"shape": "box", "size_m": (0.3, 0.3, 0.05)}] * 5},
            ["world.workspace", "no room in it for 1 object and 5 obstacles"],
        ),
        (
            {"object": {"shape": "box", "size_m": (0.5, 0.5, 0.3)}, "gripper": "blocked"},
            ["0.3 m high", "inside the gripper"],
        ),
    ],
    ids=["obstacles", "object"],
)
def test_worlds_without_room_are_refused_when_they_are_made(world, said):
    with pytest.raises(ConfigError) as error:
        WorldBatch(WorldConfig(**world), 1)
    assert_one_line(error.value, *said)


def test_a_run_learns_with_them_on_a_robot_of_five_joints_and_goes_on(tmp_path):
    tree = tiny_config(total_env_steps=400).model_dump()
    small = [{"shape": "box", "size_m": (0.02, 0.02, 0.03)}, {"shape": "sphere", "size_m": (0.02,)}]
    tree["world"] |= {"obstacles": small, "observed": SEEN, "object_size_m": 0.04}
    tree["world"] |= {"robot": str(write_robot(tmp_path)), "workspace": dict.fromkeys(SIDES, 0.2)}
    config = type(tiny_config()).model_validate(tree)
    _, first = play(tmp_path / "run", config)
    longer = config.model_copy(update={"run": config.run.model_copy(update={"total_env_steps": 800})})
    _, second = play(tmp_path / "run", longer, resume=True)
    assert second.num_env_steps > first.num_env_steps >= 400
