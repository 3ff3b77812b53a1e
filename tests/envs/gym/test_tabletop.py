"""The Gymnasium goal environment: the convention, both checkers, exact seeds and states."""

import copy
import pickle
import sys
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from service.base.errors import TandemError
from service.config import WorldConfig
from service.envs.gym.registration import TABLETOP_ID
from service.envs.gym.tabletop import TabletopEnv
from service.envs.gym.vector import TabletopVectorEnv
from service.envs.task import EPISODE_STEPS, Task

CONFIG = WorldConfig(physics_step_s=0.004, num_substeps=10)


@pytest.fixture
def env():
    env = TabletopEnv(CONFIG)
    yield env
    env.close()


@pytest.fixture
def made():
    env = gymnasium.make(TABLETOP_ID, config=CONFIG)
    yield env
    env.close()


def play(env, actions):
    """Everything that was returned, in one row per step."""
    rows = []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        flat = np.concatenate([observation[key] for key in sorted(observation)])
        rows.append([*flat, reward, terminated, truncated, info["is_success"]])
    return np.array(rows)


def random_actions(num, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (num, 4)).astype(np.float32)


def assert_same(left, right):
    assert left.keys() == right.keys()
    for key in left:
        np.testing.assert_array_equal(left[key], right[key])


def test_made_by_its_name(made):
    assert isinstance(made.unwrapped, TabletopEnv)
    direct = gymnasium.make(f"tandem_skills:{TABLETOP_ID}", task="inair")
    assert direct.unwrapped.rules.task.goals == "volume"
    direct.close()


@pytest.mark.parametrize(("task", "num_steps"), [(None, EPISODE_STEPS), (Task("Short", episode_steps=3), 3)])
def test_an_episode_is_as_long_as_its_task(task, num_steps):
    one = gymnasium.make(TABLETOP_ID, config=CONFIG, task=task)
    many = gymnasium.make_vec(TABLETOP_ID, num_envs=2, config=CONFIG, task=task)
    one.reset(seed=0)
    many.reset(seed=0)
    action = np.zeros(4, dtype=np.float32)
    ends = [(one.step(action)[3], *many.step(np.stack([action] * 2))[3].tolist()) for _ in range(num_steps)]
    assert ends == [(False,) * 3] * (num_steps - 1) + [(True,) * 3]
    one.close()
    many.close()


@pytest.mark.parametrize(
    ("options", "expected"), [({}, 50), ({"max_episode_steps": 60}, 60), ({"max_episode_steps": -1}, None)]
)
def test_make_says_where_episodes_of_a_named_task_end(options, expected):
    one, many = gymnasium.make("tandem/Push-v1", **options), gymnasium.make_vec("tandem/Push-v1", num_envs=2, **options)
    one.reset(seed=0)
    many.reset(seed=0)
    still = np.zeros((2, 4), dtype=np.float32)
    ends = [(one.step(still[0])[3], *many.step(still)[3].tolist()) for _ in range(expected or 61)]
    assert ends == [(False,) * 3] * (len(ends) - 1) + [(expected is not None,) * 3]
    one.close()
    many.close()


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_a_name_with_a_task_takes_no_other_task(make):
    with pytest.raises(TandemError, match="tandem/Wall-v1 has a task, and another one would leave out its world: take"):
        make("tandem/Wall-v1", task=Task("Mine"))


def test_nothing_is_stepped_before_an_episode_begins(env):
    envs = TabletopVectorEnv(2, CONFIG, num_threads=1)
    for each, still in ((env, np.zeros(4)), (envs, np.zeros((2, 4)))):
        with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before step"):
            each.step(still)
        each.restore(each.state())
        each.step(still)
    envs.close()


def test_films_have_the_pace_of_the_world(env):
    assert env.metadata["render_fps"] == TabletopEnv.metadata["render_fps"] == 25
    faster = TabletopEnv(WorldConfig(physics_step_s=0.005, num_substeps=4))
    assert faster.metadata["render_fps"] == 50
    faster.close()


def test_reward_is_paid_at_every_step_on_target(env):
    observation, info = env.reset(seed=0)
    assert info == {"is_success": False}
    state = env.state()
    np.testing.assert_allclose(observation["desired_goal"], state.goal[0], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(observation["achieved_goal"], observation["observation"][5:8])
    rewards = {}
    for offset_m in (0.0, 0.04, 0.06):
        state.goal[:] = state.worlds[:, 10:13] + np.array([0.0, 0.0, offset_m])
        env.restore(state)
        rows = play(env, np.zeros((5, 4), dtype=np.float32))
        np.testing.assert_array_equal(rows[:, -1], rows[:, -4])
        rewards[offset_m] = rows[:, -4].tolist()
    assert rewards == {0.0: [1.0] * 5, 0.04: [1.0] * 5, 0.06: [0.0] * 5}


def test_compute_reward_by_hand(env):
    achieved = np.array([[0.0, 0.0, 0.0], [0.03, 0.04, 0.0], [0.03, 0.0401, 0.0], [1.0, 1.0, 1.0]])
    found = env.compute_reward(achieved, np.zeros((4, 3)), [{}] * 4)
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, [1.0, 1.0, 0.0, 0.0])
    assert env.compute_reward(achieved[1], np.zeros(3), {}) == 1.0
    assert env.compute_reward(achieved.reshape(2, 2, 3), np.zeros(3), None).shape == (2, 2)
    wide = TabletopEnv(CONFIG, success_distance_m=0.2)
    assert wide.compute_reward(np.array([0.19, 0.0, 0.0]), np.zeros(3), {}) == 1.0
    wide.close()


@pytest.mark.parametrize("task", [None, "box"])
def test_a_restored_state_continues_bit_identically(task):
    env = TabletopEnv(CONFIG, task=task)
    start, _ = env.reset(seed=5)
    assert (env.reset(seed=6)[0]["achieved_goal"] != start["achieved_goal"]).any()
    assert_same(env.reset(seed=5)[0], start)
    play(env, random_actions(7))
    state = env.state()
    expected, following = play(env, random_actions(15, seed=1)), env.reset()[0]
    assert (following["desired_goal"] != start["desired_goal"]).any()
    for other in (env, TabletopEnv(CONFIG, task=task)):
        observation = other.restore(state)
        assert observation in env.observation_space
        np.testing.assert_array_equal(play(other, random_actions(15, seed=1)), expected)
        assert_same(other.reset()[0], following)
        other.close()


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["deepcopy", "pickle"]
)
def test_a_copy_goes_on_by_itself_with_the_same_bits(env, copied):
    """As where a planner tries actions in copies."""
    env.reset(seed=3)
    play(env, random_actions(5))
    env._renderer = object()
    other, actions = copied(env), random_actions(60, seed=1)
    there = play(other, actions)
    env._renderer = None
    assert np.array_equal(there, play(env, actions))
    assert_same(env.reset()[0], other.reset()[0])
    other.close()
    assert np.isfinite(play(env, actions[:1])).all()
    with pytest.raises(TandemError, match="step of worlds that are closed: make new ones"):
        other.step(actions[0])


def test_it_is_drawn_when_asked_by_a_renderer_that_is_closed(monkeypatch, env):
    """By one that needs no OpenGL."""
    calls = []

    class Renderer:
        def __init__(self, config, width, height):
            calls.append((config, width, height))

        def render(self, state, goal):
            calls.append((state.copy(), goal.copy()))

        def close(self):
            calls.append("close")

    module = SimpleNamespace(SceneRenderer=Renderer)
    monkeypatch.setitem(sys.modules, "service.envs.rendering.renderer", module)
    env.reset(seed=0)
    assert env.render() is None
    drawn = TabletopEnv(CONFIG, render_mode="rgb_array", width=160, height=120)
    drawn.reset(seed=0)
    assert calls == []
    for _ in range(2):
        drawn.render()
    drawn.close()
    assert (calls[0], calls[3]) == ((CONFIG, 160, 120), "close")
    for state, goal in calls[1:3]:
        np.testing.assert_array_equal(state, drawn.state().worlds[0])
        np.testing.assert_array_equal(goal, drawn.state().goal[0])


def test_an_object_in_free_fall_stays_in_the_space(env):
    env.reset(seed=0)
    state = env.state()
    state.worlds[0, 10:13] = [2.0, 0.0, -500.0]
    assert env.restore(state) in env.observation_space
    observation, reward, *_ = env.step(np.zeros(4, dtype=np.float32))
    assert observation in env.observation_space
    assert reward == 0.0


def test_a_diverged_world_ends_the_episode(env):
    env.reset(seed=0)
    state = env.state()
    state.worlds[0, 29] = 1e200
    env.restore(state)
    observation, _, terminated, truncated, info = env.step(np.zeros(4, dtype=np.float32))
    assert (terminated, truncated, info["diverged"]) == (False, True, True)
    assert observation in env.observation_space
    env.reset()
    assert env.step(np.zeros(4, dtype=np.float32))[4]["diverged"] is False


@pytest.mark.parametrize("action", [np.zeros(3), np.zeros((1, 4)), np.array([0.0, np.nan, 0.0, 0.0])])
def test_bad_actions_are_refused(env, action):
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action: expected shape \(4,\), |actions of 1 of 1 worlds are not finite"):
        env.step(action.astype(np.float32))


def test_no_worlds_are_refused():
    with pytest.raises(ValueError, match="num_envs = 0; give at least 1"):
        TabletopVectorEnv(0, CONFIG)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"max_episode_steps": 0}, "max_episode_steps = 0; give at least 1, or -1"),
        ({"render_mode": "rgb_array"}, "render_mode = 'rgb_array'; .* vectorization_mode=\"sync\""),
        ({"config": {"object": "sphere"}}, "config is a dict: give a WorldConfig"),
    ],
)
def test_bad_options_of_many_are_named(options, said):
    with pytest.raises(ValueError, match=said) as caught:
        TabletopVectorEnv(2, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("option", "value"), [("render_mode", "human"), ("success_distance_m", 0.0)])
def test_bad_options_are_named(option, value):
    with pytest.raises(TandemError, match=rf"{option} = {value!r}") as caught:
        TabletopEnv(CONFIG, **{option: value})
    assert "\n" not in str(caught.value)
