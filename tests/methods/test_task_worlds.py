"""The worlds of a learner, beside single environments under a time limit."""

import gymnasium
import numpy as np
import pytest

import service.envs.gym.registration  # noqa: F401 - names the environments
from service.config import WorldConfig
from service.envs.gym.vector import TabletopVectorEnv
from service.methods.compose import ComposePrimitivesVector
from service.methods.task_worlds import TaskWorlds
from service.policies.learned_policy import learner_inputs

CONFIG = WorldConfig(physics_step_s=0.005, num_substeps=8)
NUM, LENGTH, SEED = 3, 6, 8


def make(task="push", num=NUM, seed=SEED):
    return TaskWorlds(TabletopVectorEnv(num, CONFIG, task=task, max_episode_steps=LENGTH, num_threads=1), seed)


@pytest.fixture
def ours():
    worlds = make()
    yield worlds
    worlds.close()


def test_transitions_are_those_of_single_environments(ours):
    name = "tandem_skills:tandem/Push-v1"
    single = [gymnasium.make(name, config=CONFIG, max_episode_steps=LENGTH) for _ in range(NUM)]
    seen = [env.reset(seed=SEED + world)[0] for world, env in enumerate(single)]
    before, rng, returns, ends = [each["observation"] for each in seen], np.random.default_rng(0), np.zeros(NUM), []
    for step in range(1, 3 * LENGTH + 1):
        shown = [np.array([each[name] for each in seen]) for name in ("observation", "desired_goal")]
        np.testing.assert_array_equal(ours.inputs(), learner_inputs(np.array(before), *shown))
        actions = rng.uniform(-1.0, 1.0, (NUM, 4)).astype(np.float32)
        columns, ended = ours.step(actions)
        np.testing.assert_array_equal(columns["previous"], before)
        np.testing.assert_array_equal(columns["positions"], shown[0])
        np.testing.assert_array_equal(columns["goal"], shown[1])
        np.testing.assert_array_equal(columns["action"], actions)
        before = shown[0]
        for world, env in enumerate(single):
            seen[world], reward, _, truncated, info = env.step(actions[world])
            np.testing.assert_array_equal(columns["following"][world], seen[world]["observation"])
            assert columns["reward"][world, 0] == reward
            assert ended[world] == truncated == (step % LENGTH == 0)
            returns[world] += reward
            if truncated:
                ends.append((returns[world], info["is_success"]))
                returns[world] = 0.0
                seen[world], _ = env.reset()
                before[world] = seen[world]["observation"]
    assert ours.finished == ends
    assert len(ends) == 3 * NUM
    assert sum(total for total, _ in ends) > 0.0


def test_a_world_that_ends_alone_begins_alone(ours):
    """Where physics diverged, one world starts anew in the middle of the others' episodes."""
    actions = np.full((NUM, 4), 0.5, dtype=np.float32)
    for _ in range(2):
        ours.env.rules.elapsed[1] = LENGTH - 1
        columns, ended = ours.step(actions)
        assert ended.tolist() == [False, True, False]
        after, _ = ours.step(actions)
        np.testing.assert_array_equal(after["previous"][1], after["positions"][1])
        assert not np.array_equal(after["positions"][1], columns["following"][1])
        np.testing.assert_array_equal(after["previous"][::2], columns["positions"][::2])
        np.testing.assert_array_equal(after["positions"][::2], columns["following"][::2])


def test_restored_worlds_go_on_bit_for_bit(champion):
    def composed(seed):
        worlds = TabletopVectorEnv(NUM, CONFIG, task="box", max_episode_steps=LENGTH, num_threads=1)
        return TaskWorlds(ComposePrimitivesVector(worlds, champion), seed)

    first, second = composed(1), composed(2)
    assert first.num_actions == champion.primitives.num_primitives
    rng = np.random.default_rng(0)
    for _ in range(LENGTH + 2):  # into the second episode
        first.step(rng.uniform(-1.0, 1.0, (NUM, first.num_actions)).astype(np.float32))
    second.load_state(*first.state())
    first.finished.clear()
    for _ in range(2 * LENGTH):
        np.testing.assert_array_equal(first.inputs(), second.inputs())
        actions = rng.uniform(-1.0, 1.0, (NUM, first.num_actions)).astype(np.float32)
        one, other = first.step(actions), second.step(actions)
        for name, values in one[0].items():
            np.testing.assert_array_equal(values, other[0][name])
        np.testing.assert_array_equal(one[1], other[1])
    assert first.finished == second.finished
    assert len(first.finished) == 2 * NUM
    first.close()
    second.close()


def test_what_is_paid_for_another_goal(ours):
    following = np.zeros((3, 11), np.float32)
    following[:, 5:8] = [[0.0499, 0.0, 0.0], [0.0501, 0.0, 0.0], [0.0, 0.0, -0.0599]]
    np.testing.assert_array_equal(ours.rewards({"following": following}, np.zeros((3, 3), np.float32)), [1.0, 0.0, 0.0])


def test_inputs_by_hand():
    positions = np.zeros((1, 11), np.float32)
    positions[0, 5:8] = [0.1, 0.2, 0.3]
    goal = np.float32([[0.15, 0.1, 0.3]])
    moved = np.float32([[0.02, 0.0, -0.01, 0.001, 0.0, 0.0, 0.2, -0.04, 0.0, 0.0, 0.0]])  # fingers are left out
    found = learner_inputs(positions - moved, positions, goal)
    assert found.shape == (1, 23)
    assert found.dtype == np.float32
    middle = np.array([0.0, 0.0, 0.15])
    expected = [
        *(-middle / 0.12), -1.0, -1.0, *((positions[0, 5:8] - middle) / 0.12), 0.0, 0.0, 0.0,
        1.0, 0.0, -0.5, 0.0, 5.0, -2.0,  # movements in units of 2 cm, at most five
        *((goal[0] - middle) / 0.12), 0.5, -1.0, 0.0,
    ]  # fmt: skip
    np.testing.assert_allclose(found[0], expected, atol=1e-5)
