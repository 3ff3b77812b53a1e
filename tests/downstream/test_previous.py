import numpy as np
import pytest

from service.config import WorldConfig
from service.downstream.previous import PREVIOUS, PreviousPositionsVector
from service.envs.gym.vector import TabletopVectorEnv

CONFIG = WorldConfig(physics_step_s=0.005, num_substeps=8)
NUM, LENGTH = 3, 4


@pytest.fixture
def env():
    worlds = TabletopVectorEnv(NUM, CONFIG, task="push", max_episode_steps=LENGTH, num_threads=1)
    env = PreviousPositionsVector(worlds)
    yield env
    env.close()


def actions(rng):
    return rng.uniform(-1.0, 1.0, (NUM, 4)).astype(np.float32)


def test_it_shows_the_positions_of_the_step_before(env):
    rng = np.random.default_rng(0)
    observation, _ = env.reset(seed=1)
    assert observation in env.observation_space
    np.testing.assert_array_equal(observation[PREVIOUS], observation["observation"])
    for step in range(1, 2 * LENGTH + 1):
        before = observation["observation"].copy()
        observation, _, _, truncated, info = env.step(actions(rng))
        assert observation in env.observation_space
        assert not np.array_equal(before, observation["observation"])
        if step % LENGTH:
            np.testing.assert_array_equal(observation[PREVIOUS], before)
            continue
        assert truncated.all()
        np.testing.assert_array_equal(observation[PREVIOUS], observation["observation"])
        for world in range(NUM):
            last = info["final_obs"][world]
            np.testing.assert_array_equal(last[PREVIOUS], before[world])
            assert not np.array_equal(last["observation"], observation["observation"][world])


def test_a_world_that_ends_alone_begins_alone(env):
    """Where physics diverged, one world starts anew in the middle of the others' episodes."""
    observation, _ = env.reset(seed=1)
    for _ in range(2):
        before = observation["observation"]
        env.env._elapsed[1] = LENGTH - 1
        observation, _, _, truncated, _ = env.step(np.full((NUM, 4), 0.5, dtype=np.float32))
        assert truncated.tolist() == [False, True, False]
        np.testing.assert_array_equal(observation[PREVIOUS][1], observation["observation"][1])
        np.testing.assert_array_equal(observation[PREVIOUS][::2], before[::2])


def test_it_continues_from_a_state_in_the_middle_of_an_episode(env):
    rng = np.random.default_rng(0)
    env.reset(seed=1)
    for _ in range(2):
        expected, *_ = env.step(actions(rng))
    state, action = env.state(), actions(rng)
    follows, *_ = env.step(action)
    env.reset(seed=9)
    found = env.restore(state)
    again, *_ = env.step(action)
    for one, other in ((found, expected), (again, follows)):
        for key in expected:
            np.testing.assert_array_equal(one[key], other[key])
