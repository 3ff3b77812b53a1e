"""Fixtures by description: things on the table that nothing moves, and that nobody asks to be reached into."""

import mujoco
import numpy as np
import pytest

from service.base.errors import ConfigError
from service.config import WorldConfig
from service.config.objects import FixtureConfig
from service.envs.batch import WorldBatch
from service.envs.sampling import draw_first, sample_goals
from tests.envs.scripted import CLOSE, drive
from tests.runs.runs import assert_one_line

BLOCK = {"shape": "box", "size_m": (0.10, 0.06, 0.04), "position_m": (-0.05, 0.1)}
POST = {"shape": "cylinder", "size_m": (0.04, 0.2), "position_m": (0.08, -0.1)}
WORLD = WorldConfig(fixtures=[BLOCK, POST])


def test_the_box_around_one_that_is_turned_by_hand():
    fixture = FixtureConfig(**BLOCK, turn_rad=np.pi / 2, bottom_m=0.3)
    np.testing.assert_allclose(fixture.corners_m, [(-0.08, 0.05, 0.3), (-0.02, 0.15, 0.34)])
    slanted = FixtureConfig(**BLOCK, turn_rad=-np.pi / 4)
    half = (0.05 + 0.03) / np.sqrt(2)
    np.testing.assert_allclose(slanted.corners_m[0], (-0.05 - half, 0.1 - half, 0.0))


def test_they_stand_where_they_are_described_and_carry_the_object():
    with WorldBatch(WORLD, 1) as worlds:
        data = mujoco.MjData(worlds.model)
        mujoco.mj_kinematics(worlds.model, data)
        np.testing.assert_allclose(data.geom("fixture_0-0").xpos, (-0.05, 0.1, 0.02))
        np.testing.assert_allclose(data.geom("fixture_1-0").xpos, (0.08, -0.1, 0.1))
        states = worlds.states.copy()
        states[:, worlds.layout["object"]] = (-0.05, 0.1, 0.066)  # a millimetre above the block
        worlds.restore(states)
        for _ in range(40):
            worlds.step(np.zeros((1, 4), dtype=np.float32))
        np.testing.assert_allclose(worlds.object_position, [[-0.05, 0.1, 0.065]], atol=1e-3)


def test_the_gripper_cannot_pass_through():
    with WorldBatch(WORLD, 1) as worlds:
        beside, beyond = np.array([[0.03, -0.1, 0.1]]), np.array([[0.14, -0.1, 0.1]])
        for _ in drive(worlds, lambda: beside, CLOSE, 10):
            pass
        for _ in drive(worlds, lambda: beyond, CLOSE, 15):
            pass
        assert worlds.ee_position[0, 0] < 0.07


def inside(position, gap_m=(0.0, 0.0, 0.0)):
    half = 0.025 + np.array(gap_m)
    boxes = [(np.array(low) - half, np.array(high) + half) for low, high in (each.corners_m for each in WORLD.fixtures)]
    return np.any([((position > low) & (position < high)).all(axis=1) for low, high in boxes], axis=0)


@pytest.mark.parametrize("kind", ["table", "air", "mixed", "volume"])
def test_no_goal_is_inside_and_all_other_places_are_drawn(kind):
    goals = sample_goals(kind, np.random.default_rng(0), 5000, WORLD, 0.05)
    assert not inside(goals).any()
    assert kind != "air" or goals[:, 2].min() >= 0.075  # out of reach of an object on the table
    plain = sample_goals(kind, np.random.default_rng(0), 5000, WorldConfig(), 0.05)
    assert inside(plain).any()
    kept = ~inside(plain)
    assert (goals == plain).all(axis=1).mean() >= kept.mean() - 1e-9  # those that were clear are as they were


def test_an_open_finger_fits_beside_every_start():
    position = draw_first(np.random.default_rng(0), 5000, WORLD).object
    assert not inside(position, (0.005, 0.04, 0.005)).any()
    assert inside(position, (0.02, 0.06, 0.02)).any()


@pytest.mark.parametrize(
    ("world", "said"),
    [
        (
            {"fixtures": [{**POST, "position_m": (-0.05, 0.0)}]},
            ["m deep inside world.fixtures[0]: raise world.start_height_m"],
        ),
        ({"fixtures": [{**BLOCK, "size_m": (0.5, 0.5, 0.04), "position_m": (-0.05, 0.0)}]}, ["leave no room"]),
    ],
    ids=["in the gripper", "everywhere"],
)
def test_worlds_that_cannot_begin_are_one_line(world, said):
    with pytest.raises(ConfigError) as error, WorldBatch(WorldConfig(**world), 1) as worlds:
        worlds.reset(np.random.default_rng(0))
    assert_one_line(error.value, *said)
