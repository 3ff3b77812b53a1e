"""The adapter beside Stable-Baselines3's own vector environment of single ones, bit for bit."""

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from service.config import WorldConfig
from service.downstream.compose import ComposePrimitivesVector
from service.downstream.vec_env import PREVIOUS, WorldsVecEnv
from service.envs.gym.vector import TabletopVectorEnv

CONFIG = WorldConfig(physics_step_s=0.005, num_substeps=8)
NUM, LENGTH = 3, 6


def make(task="push", num=NUM):
    return WorldsVecEnv(TabletopVectorEnv(num, CONFIG, task=task, max_episode_steps=LENGTH, num_threads=1))


def single():
    return Monitor(
        gymnasium.make("service.envs.gym.registration:tandem/Push-v1", config=CONFIG, max_episode_steps=LENGTH)
    )


@pytest.fixture
def ours():
    env = make()
    yield env
    env.close()


def known(observation):
    """What single environments show as well."""
    return {key: value for key, value in observation.items() if key != PREVIOUS}


def assert_same(ours, theirs):
    assert ours.keys() == theirs.keys()
    for key in ours:
        np.testing.assert_array_equal(ours[key], theirs[key])
        assert ours[key].dtype == theirs[key].dtype


def test_it_is_what_single_environments_are(ours):
    theirs = DummyVecEnv([single] * NUM)
    assert dict(ours.observation_space) == {**theirs.observation_space, PREVIOUS: ours.observation_space["observation"]}
    assert ours.action_space == theirs.action_space
    ours.seed(8)
    theirs.seed(8)
    assert_same(known(ours.reset()), theirs.reset())
    rng, num_done, paid = np.random.default_rng(0), 0, 0.0
    for _ in range(3 * LENGTH):
        actions = rng.uniform(-1.0, 1.0, (NUM, 4)).astype(np.float32)
        observation, reward, done, infos = ours.step(actions)
        expected_observation, expected_reward, expected_done, expected_infos = theirs.step(actions)
        assert_same(known(observation), expected_observation)
        np.testing.assert_array_equal(reward, expected_reward)
        assert reward.dtype == expected_reward.dtype
        np.testing.assert_array_equal(done, expected_done)
        paid += reward.sum()
        for info, expected in zip(infos, expected_infos, strict=True):
            assert info["TimeLimit.truncated"] == expected["TimeLimit.truncated"]
            assert info["is_success"] == expected["is_success"]
            assert ("terminal_observation" in info) == ("terminal_observation" in expected)
            if "terminal_observation" in info:
                num_done += 1
                assert_same(known(info["terminal_observation"]), expected["terminal_observation"])
                assert info["episode"]["r"] == pytest.approx(expected["episode"]["r"])
                assert info["episode"]["l"] == expected["episode"]["l"]
    assert num_done == 3 * NUM
    assert sum(total for total, _ in ours.finished) == paid > 0.0
    theirs.close()


def test_it_shows_the_positions_of_the_step_before(ours):
    rng = np.random.default_rng(0)
    ours.seed(1)
    observation = ours.reset()
    np.testing.assert_array_equal(observation[PREVIOUS], observation["observation"])
    for step in range(1, 2 * LENGTH + 1):
        before = observation["observation"].copy()
        observation, _, done, infos = ours.step(rng.uniform(-1.0, 1.0, (NUM, 4)).astype(np.float32))
        assert {key: rows[0] for key, rows in observation.items()} in ours.observation_space
        assert not np.array_equal(before, observation["observation"])
        if step % LENGTH:
            np.testing.assert_array_equal(observation[PREVIOUS], before)
            continue
        assert done.all()
        np.testing.assert_array_equal(observation[PREVIOUS], observation["observation"])
        for world in range(NUM):
            last = infos[world]["terminal_observation"]
            np.testing.assert_array_equal(last[PREVIOUS], before[world])
            assert not np.array_equal(last["observation"], observation["observation"][world])


def test_a_world_that_ends_alone_begins_alone(ours):
    """Where physics diverged, one world starts anew in the middle of the others' episodes."""
    ours.seed(1)
    observation = ours.reset()
    for _ in range(2):
        before = observation["observation"]
        ours.env._elapsed[1] = LENGTH - 1
        observation, _, done, _ = ours.step(np.full((NUM, 4), 0.5, dtype=np.float32))
        assert done.tolist() == [False, True, False]
        np.testing.assert_array_equal(observation[PREVIOUS][1], observation["observation"][1])
        np.testing.assert_array_equal(observation[PREVIOUS][::2], before[::2])


def test_without_seeds_it_goes_on_with_the_random_numbers(ours):
    ours.seed(5)
    first, second = ours.reset(), ours.reset()
    assert not np.array_equal(first["desired_goal"], second["desired_goal"])


def test_a_restored_environment_goes_on_bit_for_bit(champion):
    def composed():
        worlds = TabletopVectorEnv(NUM, CONFIG, task="box", max_episode_steps=LENGTH, num_threads=1)
        return WorldsVecEnv(ComposePrimitivesVector(worlds, champion))

    first, second = composed(), composed()
    first.seed(1)
    first.reset()
    rng = np.random.default_rng(0)
    for _ in range(LENGTH + 2):  # into the second episode
        expected = first.step(rng.uniform(-1.0, 1.0, (NUM, 4)).astype(np.float32))[0]
    assert_same(second.restore(first.state()), expected)
    for _ in range(2 * LENGTH):
        actions = rng.uniform(-1.0, 1.0, (NUM, 4)).astype(np.float32)
        one, other = first.step(actions), second.step(actions)
        assert_same(one[0], other[0])
        assert one[3][0].get("episode") == other[3][0].get("episode")
    first.close()
    second.close()


def test_a_state_of_other_worlds_is_refused(ours):
    other = make(num=2)
    other.reset()
    with pytest.raises(ValueError, match=r"expected shape \(3, "):
        ours.restore(other.state())
    other.close()


def test_hindsight_recomputes_rewards_as_by_hand(ours):
    """Relabelled goals are places the object came to in the same episode, and are paid within 5 cm."""
    buffer = HerReplayBuffer(
        60, ours.observation_space, ours.action_space, env=ours, n_envs=NUM, device="cpu", n_sampled_goal=4
    )
    ours.seed(0)
    observation, rng = ours.reset(), np.random.default_rng(1)
    for _ in range(3 * LENGTH):
        actions = rng.uniform(-1.0, 1.0, (NUM, 4)).astype(np.float32)
        following, reward, done, infos = ours.step(actions)
        last = {key: value.copy() for key, value in following.items()}
        for world in np.flatnonzero(done):
            for key in last:
                last[key][world] = infos[world]["terminal_observation"][key]
        buffer.add(observation, last, actions, reward, done, infos)
        observation = following
    np.random.seed(0)
    sample = buffer.sample(200)
    achieved, goal = (sample.next_observations[key].numpy() for key in ("achieved_goal", "desired_goal"))
    expected = (np.linalg.norm(achieved - goal, axis=1) <= 0.05).astype(np.float32)
    np.testing.assert_array_equal(sample.rewards.numpy()[:, 0], expected)
    assert expected.mean() > 0.5  # chance hardly moves it, so most places it came to are near
    assert not sample.dones.numpy().any()  # only time ends an episode, so the critic looks beyond every end


def test_what_is_asked_of_single_environments(ours):
    assert ours.get_attr("max_episode_steps", [0, 2]) == [LENGTH, LENGTH]
    assert ours.env_is_wrapped(Monitor) == [False] * NUM
    (rewards,) = ours.env_method("compute_reward", np.zeros((2, 3)), np.float32([[0, 0, 0], [1, 0, 0]]), {}, indices=0)
    np.testing.assert_array_equal(rewards, [1.0, 0.0])
    with pytest.raises(AttributeError, match="share config"):
        ours.set_attr("config", None)
