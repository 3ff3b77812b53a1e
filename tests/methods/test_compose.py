"""Composing frozen primitives: the weights, what the environment is handed, both checkers, learners, bad input."""

import dataclasses
import math
import re
import warnings
from itertools import pairwise
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium
from stable_baselines3.common.env_checker import check_env as check_stable_baselines

import service
import service.envs.gym.registration
from service.base.errors import TandemError
from service.config import WorldConfig
from service.config.skills import SkillsConfig
from service.envs.gym.tabletop import TabletopEnv
from service.envs.gym.vector import TabletopVectorEnv
from service.methods.compose import (
    ComposePrimitives,
    ComposePrimitivesVector,
    check_primitives,
)
from service.policies.frozen_skills import FrozenSkills
from service.policies.learned_policy import action_weights
from service.policies.numpy_policy import NumpyGaussianPolicy
from service.registry.digest import parameters_digest

DOCUMENT = Path(__file__).parents[2] / "docs" / "downstream.md"
CONFIG = WorldConfig(physics_step_s=0.005, num_substeps=8)
NUM_PRIMITIVES = 8


@pytest.fixture(scope="module")
def trained():
    return service.load("panda-cube@champion", registry="no registry here")


@pytest.fixture
def env(trained):
    env = ComposePrimitives(gymnasium.make("tandem/Wall-v1", config=CONFIG), trained)
    yield env
    env.close()


class Recorder(gymnasium.Wrapper):
    """Keeps the actions that reach the environment."""

    def __init__(self, env):
        super().__init__(env)
        self.actions = []

    def step(self, action):
        self.actions.append(action)
        return self.env.step(action)


def test_weights_by_hand():
    actions = np.array([-1.0, 0.0, 1.0, 5.0, -9.0], dtype=np.float32)
    found = action_weights(actions)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, [0.01, 0.1, 1.0, 1.0, 0.01], rtol=1e-6)


def test_weights_have_the_range_of_bobs_own_gate(trained):
    assert action_weights(np.float32([-1.0]))[0] == pytest.approx(trained.config.policy.bob.weight_floor)


def test_the_environment_is_handed_the_mean_of_the_composition(trained):
    recorder = Recorder(TabletopEnv(CONFIG))
    env = ComposePrimitives(recorder, trained)
    observation, _ = env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = rng.uniform(-1.0, 1.0, NUM_PRIMITIVES).astype(np.float32)
        means, variances = trained.primitives.primitives(observation["observation"])
        precision = (10.0 ** (action - 1.0))[:, None] / variances
        expected = np.clip((precision * means).sum(0) / precision.sum(0), -1.0, 1.0)
        observation, *_ = env.step(action)
        np.testing.assert_allclose(recorder.actions[-1], expected, rtol=0, atol=1e-5)
    env.close()


def test_a_residual_is_added_to_the_mean(trained):
    recorder = Recorder(TabletopEnv(CONFIG))
    env = ComposePrimitives(recorder, trained, residual=0.25)
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (NUM_PRIMITIVES + 4,), np.float32)
    observation, _ = env.reset(seed=0)
    weights, added = np.float32([0.3, -0.2, 1.0, -1.0, 0.0, 0.4, -0.6, 0.9]), np.float32([1.0, -1.0, 0.5, 0.0])
    mean, _ = trained.primitives.compose(observation["observation"], action_weights(weights))
    env.step(np.concatenate((weights, added)))
    expected = np.clip(mean + np.float32([0.25, -0.25, 0.125, 0.0]), -1.0, 1.0)
    np.testing.assert_allclose(recorder.actions[-1], expected, rtol=0, atol=1e-6)
    with pytest.raises(TandemError, match=r"expected shape \(12,\), .* 8 primitives and 4 of the residual, got \(8,\)"):
        env.step(weights)
    env.close()


def test_a_residual_is_no_more_than_it_says(trained):
    recorder = Recorder(TabletopEnv(CONFIG))
    env = ComposePrimitives(recorder, trained, residual=0.1)
    for number in (1.0, 9.0):
        env.reset(seed=0)
        env.step(np.concatenate((np.zeros(NUM_PRIMITIVES), np.full(4, number))).astype(np.float32))
    np.testing.assert_array_equal(*recorder.actions)
    env.close()


def test_a_restored_state_continues_bit_identically(trained):
    env = ComposePrimitives(gymnasium.make("tandem/Push-v1", config=CONFIG, max_episode_steps=-1), trained)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (6, NUM_PRIMITIVES)).astype(np.float32)
    for action in actions:
        env.step(action)
    state = env.state()
    expected = [env.step(action)[0]["observation"] for action in actions]
    env.restore(state)
    np.testing.assert_array_equal([env.step(action)[0]["observation"] for action in actions], expected)
    env.close()


def test_equal_weights_are_one_composition(env):
    ends = []
    for value in (-0.7, 0.9):
        env.reset(seed=3)
        ends.append(env.step(np.full(NUM_PRIMITIVES, value, dtype=np.float32))[0]["observation"])
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-6)


def test_what_the_learner_sees_and_is_paid_stays(env):
    inner = env.unwrapped
    assert env.observation_space == inner.observation_space
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (NUM_PRIMITIVES,), np.float32)
    achieved = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    np.testing.assert_array_equal(env.compute_reward(achieved, np.zeros((2, 3)), [{}] * 2), [1.0, 0.0])


def test_the_checkers_have_nothing_to_say(env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*is different from the unwrapped version")  # it is a wrapper
        check_gymnasium(env, skip_render_check=True)
        check_stable_baselines(env)


def test_many_at_once_do_the_same(trained, env):
    many = ComposePrimitivesVector(TabletopVectorEnv(3, CONFIG, task="wall"), trained)
    assert many.action_space.shape == (3, NUM_PRIMITIVES)
    assert many.single_action_space == env.action_space
    rng = np.random.default_rng(0)
    seen, alone = many.reset(seed=6)[0], env.reset(seed=7)[0]
    for _ in range(10):
        # one row of a matrix product may differ from the product of one row in the last bit
        np.testing.assert_allclose(seen["observation"][1], alone["observation"], rtol=0, atol=1e-5)
        actions = rng.uniform(-1.0, 1.0, (3, NUM_PRIMITIVES)).astype(np.float32)
        seen, alone = many.step(actions)[0], env.step(actions[1])[0]
    many.close()


def test_a_new_episode_acts_on_its_own_start(trained):
    """After the end of an episode the next composition sees the first observation of the new one."""
    many = ComposePrimitivesVector(TabletopVectorEnv(2, CONFIG, max_episode_steps=3), trained)
    many.reset(seed=0)
    actions = np.zeros((2, NUM_PRIMITIVES), dtype=np.float32)
    for _ in range(3):
        observation, _, _, truncated, _ = many.step(actions)
    assert truncated.all()
    mean, _ = trained.primitives.compose(observation["observation"], action_weights(actions))
    np.testing.assert_array_equal(many._compose(actions), np.clip(mean, -1.0, 1.0))
    many.close()


def test_the_digest_sees_a_single_bit(trained):
    primitives = service.load("panda-cube@champion", registry="no registry here").primitives
    assert parameters_digest(primitives) == parameters_digest(trained.primitives)
    bias = primitives.network["primitives.output_bias"]
    bias.flat[0] = np.nextafter(bias.flat[0], np.float32(9.0))
    assert parameters_digest(primitives) != parameters_digest(trained.primitives)


def layers(name, *sizes, step=1):
    """Shapes of weights and biases between every two neighbours of sizes."""
    found = {}
    for place, (inputs, outputs) in enumerate(pairwise(sizes)):
        layer = name.format(step * place)
        found |= {f"{layer}.weight": (outputs, inputs), f"{layer}.bias": (outputs,)}
    return found


def test_digests_stay_what_they_were_when_the_first_were_recorded():
    """Of Bob, ``tests/benchmarks`` has recorded ones."""
    names = ("input.offset", "input.scale", "squash.log_std_min", "squash.log_std_max")
    alone = dict(zip(names, ((5,), (5,), (), ()), strict=True)) | layers("hidden.{}", 5, 3, 2) | layers("output", 2, 8)
    skills = layers("actor.layers.{}", 20, 3, 8, step=2) | layers("network.{}", 3, 2, 3, step=2)
    alone, skills = (
        {name: np.arange(1, 1 + math.prod(shape), dtype=np.float32).reshape(shape) for name, shape in shapes.items()}
        for shapes in (alone, skills)
    )
    alone["squash.log_std_max"] *= 2
    assert parameters_digest(NumpyGaussianPolicy(alone))[:12] == "f7f5cc35f7b4"
    assert parameters_digest(FrozenSkills(skills, SkillsConfig(method="lsd")))[:12] == "490bcd275666"


class TestBadInput:
    def refused(self, words, env, primitives, **options):
        with pytest.raises(TandemError, match=words) as caught:
            ComposePrimitives(env, primitives, **options)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize(("key", "value"), [("layout", "another.robot"), ("positions", 14), ("action", 7)])
    def test_primitives_of_another_robot_or_layout(self, trained, key, value):
        manifest = trained.manifest.model_copy(update={"spaces": {**trained.manifest.spaces, key: value}})
        other = dataclasses.replace(trained, manifest=manifest)
        with pytest.raises(
            TandemError, match=rf"panda-cube@\d+ .*another robot or layout: {key} {value}; this one has"
        ):
            check_primitives(other)

    def test_an_environment_that_acts_otherwise(self, trained):
        self.refused(r"actions are Box.*\(4,\)|Box.*act by 4 numbers", gymnasium.make("Pendulum-v1"), trained)

    def test_an_environment_that_shows_something_else(self, trained):
        env = gymnasium.wrappers.FlattenObservation(TabletopEnv(CONFIG))
        self.refused(r"observations are Box.*\(17,\).*11 positions .* give positions=", env, trained)
        ours = ComposePrimitives(env, trained, positions=lambda flat: flat[-POSITIONS:])
        ours.reset(seed=0)
        ours.step(np.zeros(NUM_PRIMITIVES, dtype=np.float32))
        env.close()

    def test_an_environment_that_shows_as_many_other_positions(self):
        two = service.load("panda-two-cubes@champion", registry="no registry here")
        obstacle = {"shape": "box", "size_m": (0.04, 0.04, 0.04)}
        world = WorldConfig(obstacles=[obstacle] * 2, observed={"obstacles": True})
        env = TabletopEnv(world)
        assert env.observation_space["observation"].shape == (two.primitives.num_positions,)
        self.refused(r"panda-two-cubes@\d+ .* sees .*, and the environment shows .*obstacle", env, two)
        env.close()

    @pytest.mark.parametrize("residual", [-0.1, 1.5, float("nan")])
    def test_a_residual_out_of_its_range(self, env, trained, residual):
        self.refused(rf"residual = {residual}: .* from 0 to 1", env.unwrapped, trained, residual=residual)

    @pytest.mark.parametrize("shape", [(4,), (1, 8), ()])
    def test_weights_for_other_primitives(self, env, shape):
        env.reset(seed=0)
        with pytest.raises(TandemError, match=rf"expected shape \(8,\), .* got {re.escape(str(shape))}"):
            env.step(np.zeros(shape, dtype=np.float32))

    def test_a_step_before_the_first_reset(self, trained):
        env = ComposePrimitives(TabletopEnv(CONFIG), trained)
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(np.zeros(NUM_PRIMITIVES, dtype=np.float32))
        env.close()


POSITIONS = 11
"""``FlattenObservation`` sorts the entries by name: achieved goal, desired goal, observation."""


def test_the_documents_ten_lines_run_and_the_primitives_stay_frozen(trained):
    code, *_ = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    lines = [line for line in code.splitlines() if line.strip()]
    assert len(lines) <= 10
    assert "10_000" in code
    scope = {}
    exec(code.replace("10_000", "60"), scope)
    assert scope["model"].num_timesteps == 60
    assert scope["model"].ep_success_buffer  # what counts is in the learner's logs
    assert parameters_digest(scope["trained"].primitives) == parameters_digest(trained.primitives)
