"""Goals that a user gives: at a reset, or by the function of a task."""

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from service.base.errors import TandemError
from service.config import WorldConfig
from service.envs.gym.registration import TABLETOP_ID
from service.envs.gym.tabletop import TabletopEnv
from service.envs.gym.vector import TabletopVectorEnv
from service.envs.task import Task

CONFIG = WorldConfig(physics_step_s=0.005, num_substeps=8)
GOAL = (0.02, -0.1, 0.2)
DOCUMENT = Path(__file__).parents[3] / "docs" / "downstream.md"
STAY = np.zeros((2, 4), dtype=np.float32)


@pytest.fixture
def env():
    env = TabletopEnv(CONFIG)
    yield env
    env.close()


@pytest.fixture
def envs():
    envs = TabletopVectorEnv(2, CONFIG, num_threads=1, max_episode_steps=2)
    yield envs
    envs.close()


@pytest.mark.parametrize(
    ("world", "lowest_m"),
    [
        ({}, 0.025),
        ({"object": {"shape": "box", "size_m": (0.04, 0.04, 0.1)}}, 0.02),  # it may lie on its side
        ({"randomisation": {"object_size": (0.8, 1.2), "table_height_m": (-0.01, 0.02)}}, 0.8 * 0.025 - 0.01),
    ],
)
def test_a_goal_is_no_lower_than_an_object_can_lie(world, lowest_m):
    env = TabletopEnv(WorldConfig.model_validate(CONFIG.model_dump() | world))
    env.reset(seed=0, options={"goal": (0.0, 0.0, lowest_m)})
    with pytest.raises(TandemError, match="out of reach"):
        env.reset(options={"goal": (0.0, 0.0, lowest_m - 0.002)})
    env.close()


def test_a_goal_is_given_at_a_reset_and_nothing_else_changes(env):
    drawn, _ = env.reset(seed=3)
    following, _ = env.reset()
    given, info = env.reset(seed=3, options={"goal": GOAL})
    np.testing.assert_array_equal(given["desired_goal"], np.float32(GOAL))
    np.testing.assert_array_equal(given["observation"], drawn["observation"])
    assert info == {"is_success": False}
    at_it = env.reset(seed=3, options={"goal": given["achieved_goal"]})[1]
    assert at_it == {"is_success": True}
    env.reset(seed=3, options={"goal": GOAL})
    np.testing.assert_array_equal(env.reset()[0]["desired_goal"], following["desired_goal"])
    np.testing.assert_array_equal(env.reset(seed=3, options={})[0]["desired_goal"], drawn["desired_goal"])


def test_many_worlds_have_one_goal_or_one_each(envs):
    each = [GOAL, (-0.1, 0.1, 0.025)]
    np.testing.assert_array_equal(envs.reset(seed=0, options={"goal": each})[0]["desired_goal"], np.float32(each))
    observation, _ = envs.reset(seed=0, options={"goal": GOAL})
    np.testing.assert_array_equal(observation["desired_goal"], np.float32([GOAL, GOAL]))
    observation = envs.step(STAY)[0]
    np.testing.assert_array_equal(observation["desired_goal"], np.float32([GOAL, GOAL]))
    observation, _, _, truncated, _ = envs.step(STAY)
    assert truncated.all()
    assert (observation["desired_goal"] != np.float32(GOAL)).all()  # episodes that begin on their own


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"goal": (0.0, 0.1)}, r"options\['goal'\] has shape \(2,\), not \(3,\) or \(2, 3\)"),
        ({"goal": (0.0, np.nan, 0.1)}, "nan, 0.1.: give finite numbers, metres"),
        (
            {"goal": [GOAL, (0.9, 0.0, 0.1)]},
            r"\(0.900, 0.000, 0.100\) m is out of reach: the nearest the arm comes is \(0.\d",
        ),
        ({"goal": (0.0, 0.0, -0.1)}, r"the nearest the arm comes is \(0.000, 0.000, 0.025\) m"),
        ({"goal": (0.0, 0.0, 3.0)}, "out of reach"),
        ({"goal": (0.0, 0.0, 0.0)}, r"\(0.000, 0.000, 0.000\) m is out of reach.* \(0.000, 0.000, 0.025\) m"),
        ({"goal": "here"}, r"options\['goal'\] = 'here': give numbers, metres"),
        ({"gaol": GOAL}, "unknown option 'gaol'"),
    ],
)
def test_a_bad_goal_is_refused_in_one_line(envs, options, said):
    before = envs.reset(seed=0)[0]["desired_goal"].copy()
    with pytest.raises(TandemError, match=said) as caught:
        envs.reset(options=options)
    assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(envs.step(STAY)[0]["desired_goal"], before)


SHELF = {"shape": "box", "size_m": (0.1, 0.1, 0.1), "position_m": (0.1, 0.1)}


@pytest.mark.parametrize(
    ("world", "fitting", "inside"),
    [
        ({"fixture": "wall"}, [(-0.05, 0.0, 0.2), (-0.02, 0.0, 0.025)], [(-0.05, 0.0, 0.025), (-0.022, 0.0, 0.025)]),
        ({"fixtures": [SHELF]}, [(0.025, 0.1, 0.05), (0.1, 0.1, 0.1249)], [(0.03, 0.1, 0.05), (0.1, 0.1, 0.12)]),
    ],
)
def test_a_goal_inside_a_fixture_is_refused(world, fitting, inside):
    """A cube of 5 cm beside a wall of 1 cm, or beside and on a shelf; a height may be rounded."""
    config = WorldConfig(start_height_m=0.15, **world)
    env = TabletopEnv(config)
    for goal in fitting:
        np.testing.assert_array_equal(env.reset(options={"goal": goal})[0]["desired_goal"], np.float32(goal))
    for goal in inside:
        with pytest.raises(TandemError, match=r"options\['goal'\] \(.*\) m: an object would be inside a fixture"):
            env.reset(options={"goal": goal})
    env.close()
    drawn = [*fitting[:1], *inside, *fitting[1:]]
    drawing = TabletopEnv(config, task=Task("Drawn", goals=lambda s, rng: np.array([[drawn.pop()]])))
    for goal in reversed(fitting):  # those inside are drawn again
        np.testing.assert_array_equal(drawing.reset()[0]["desired_goal"], np.float32(goal))
    drawing.close()


def test_a_function_draws_goals_alike_for_one_world_and_many():
    def above(s, rng):
        return s.objects.place + rng.uniform((0.0, 0.0, 0.1), (0.0, 0.0, 0.2), s.objects.place.shape)

    task = Task("Above", goals=above)
    one = gymnasium.make(TABLETOP_ID, config=CONFIG, task=task)
    many = gymnasium.make_vec(TABLETOP_ID, num_envs=2, config=CONFIG, task=task)
    expected = [one.reset(seed=seed)[0] for seed in (4, 5)]
    found = many.reset(seed=4)[0]
    one.close()
    many.close()
    np.testing.assert_array_equal(found["desired_goal"], [each["desired_goal"] for each in expected])
    way = found["desired_goal"] - found["achieved_goal"]
    assert (way[:, 2] >= 0.1 - 1e-6).all()
    np.testing.assert_allclose(way[:, :2], 0.0, atol=1e-6)


def test_goals_of_a_function_are_clear_of_what_stands_there():
    low, high = (-0.1, -0.15, 0.025), (0.1, 0.15, 0.025)
    task = Task("Anywhere", goals=lambda s, rng: rng.uniform(low, high, s.objects.place.shape))
    for config in (
        WorldConfig(obstacles=[{"shape": "box", "size_m": (0.08, 0.08, 0.06)}]),
        WorldConfig(fixture="wall", start_height_m=0.12),
    ):
        env = TabletopEnv(config, task=task)
        goals = []
        for seed in range(25):
            goal = env.reset(seed=seed)[0]["desired_goal"]
            goals.append(goal)
            for place in env._worlds.places.obstacles[0]:  # the cube's edge is 5 cm, the obstacle's 8 cm
                assert np.abs(goal - place)[:2].max() >= 0.065 - 1e-6
        if config.fixture == "wall":  # 1 cm thick, in the middle of the workspace
            assert np.abs(np.array(goals)[:, 0] - config.workspace.center_x_m).min() >= 0.029
        env.close()
        assert np.ptp(goals, axis=0)[1] > 0.2


@pytest.mark.parametrize("name", ["starts", "goals"])
def test_places_of_a_function_are_not_inside_a_side_of_the_box(name):
    low, high = (-0.2, -0.15, 0.03), (0.1, 0.15, 0.03)
    task = {"goals": "table", name: lambda s, rng: rng.uniform(low, high, s.objects.place.shape)}
    envs = TabletopVectorEnv(60, CONFIG.model_copy(update={"fixture": "box"}), task=Task("Any", **task), num_threads=1)
    envs.reset(seed=0)
    place = {"starts": envs._worlds.object_position, "goals": envs._goal}[name]
    furthest = np.abs(place - envs._worlds.box_place)[:, :2].max(axis=1)
    # its sides are 4.5 to 5 cm from its middle, and the cube reaches 2.5 cm; a millimetre is allowed
    assert not ((furthest > 0.02 + 0.001 + 1e-6) & (furthest < 0.075 - 0.001 - 1e-6)).any()
    before = envs._worlds.object_position.copy()
    envs.step(np.zeros((60, 4), dtype=np.float32))
    assert np.abs(envs._worlds.object_position - before).max() < 0.006  # falls by 5 mm
    envs.close()


def test_the_documents_goals_are_where_it_says():
    _, code, *_ = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    scope = {}
    exec(code, scope)
    given = scope["observation"]["desired_goal"]
    np.testing.assert_array_equal(given, np.float32([(0.02, -0.1, 0.2), (0.0, 0.1, 0.025)]))
    drawn = scope["worlds"].reset()[0]["desired_goal"]
    np.testing.assert_allclose(drawn[:, 1:], [[0.1, 0.2], [0.1, 0.2]], rtol=0, atol=1e-6)
    assert scope["world"].reset()[0]["desired_goal"][2] > 0.075
    scope["world"].close()
    scope["worlds"].close()
