"""Frozen skills downstream: a skill set at each step, the same in learning and in evaluation, and bad input."""

import dataclasses

import numpy as np
import pytest
import torch

import service
from service.base.errors import TandemError
from service.config.task_methods import TASK_METHODS
from service.envs.gym.vector import TabletopVectorEnv
from service.envs.observations import POSITIONS
from service.methods.task import TaskLearning
from service.methods.task_check import check_fits
from service.methods.task_worlds import SkillTaskWorlds, TaskWorlds
from service.policies.frozen_skills import ZeroShotPolicy
from service.registry.loading import learned_policy
from service.registry.publishing import publish
from service.registry.registry import Registry
from tests.methods.skill_sets import CONFIG, SIZE, WORLD, made, parameters
from tests.methods.trials import small_trial

NUM, LENGTH = 3, 8


@pytest.fixture
def skills():
    return made()


def env(length=LENGTH):
    return TabletopVectorEnv(NUM, WORLD, task="push", max_episode_steps=length, num_threads=1)


def test_a_step_is_one_of_the_frozen_policy_by_the_skill_that_is_set(skills):
    ours, plain = SkillTaskWorlds(env(), 3, skills.skills), TaskWorlds(env(), 3)
    rng = np.random.default_rng(0)
    for _ in range(12):
        actions = rng.uniform(-1.0, 1.0, (NUM, SIZE)).astype(np.float32)
        found, ended = ours.step(actions)
        step, over = plain.step(skills.skills.actions(plain.previous, plain.positions, np.float32(1.5) * actions))
        for name in ("previous", "positions", "following", "goal", "reward"):
            np.testing.assert_array_equal(found[name], step[name])
        np.testing.assert_array_equal(found["action"], actions)
        np.testing.assert_array_equal(ended, over)
        np.testing.assert_array_equal(ours.inputs(), plain.inputs())
    assert ours.finished == plain.finished
    ours.close()
    plain.close()


@pytest.mark.parametrize("hold", [1, 5])
def test_a_learned_policy_holds_its_skills_as_long_as_it_was_published_to(skills, hold):
    training = TaskLearning(small_trial("lsd"), skills)
    training.loop.play(200)  # learned nothing yet: the average is the actor
    actor, worlds = training.loop.learner.actor, training.loop.worlds
    player = learned_policy(training.parameters(), skills, skills.config, hold)
    for step in range(3 * hold):
        if step % hold == 0:
            with torch.no_grad():
                actions = torch.tanh(actor(torch.from_numpy(worlds.inputs()))[0]).numpy()
        expected = skills.skills.actions(worlds.previous, worlds.positions, skills.skills.from_action(actions))
        acted = player.act_deterministic(np.concatenate((worlds.positions, worlds.goal), axis=1))
        np.testing.assert_allclose(acted, expected, rtol=0, atol=1e-5)
        worlds.step(actions)
    training.close()


def test_skills_of_actions_by_hand():
    action = np.array([[0.6, 0.0, -0.8, 0.0], [0.3, 0.0, 0.4, 0.0]], dtype=np.float32)
    expected = {"lsd": 1.5 * action, "diayn": 1.5 * action, "dads": action, "metra": action / [[1.0], [0.5]]}
    for method, skill in expected.items():
        np.testing.assert_allclose(made(method).skills.from_action(action), skill, rtol=1e-6)


def test_the_skill_towards_a_goal_is_the_direction_of_its_way_in_phi():
    """METRA's phi by hand: one hidden layer of ReLU on the place, centred and scaled."""
    skills, rng = made("metra").skills, np.random.default_rng(0)
    positions = rng.uniform(-0.1, 0.1, (5, POSITIONS.size)).astype(np.float32)
    goal = rng.uniform(-0.1, 0.3, (5, 3)).astype(np.float32)
    (first, first_bias), (second, second_bias) = skills.network

    def phi(place):
        return np.maximum((place - [0.0, 0.0, 0.15]) / 0.12 @ first + first_bias, 0.0) @ second + second_bias

    way = phi(goal) - phi(positions[:, POSITIONS["object"]])
    expected = way / np.linalg.norm(way, axis=1, keepdims=True)
    np.testing.assert_allclose(skills.towards(positions, goal), expected, atol=1e-4)


def test_zero_shot_acts_by_the_skill_towards_the_goal(skills):
    player, rng = ZeroShotPolicy(skills.skills), np.random.default_rng(0)
    rows = rng.uniform(-0.1, 0.1, (2, NUM, 14)).astype(np.float32)
    before = rows[0][:, : POSITIONS.size]
    for seen in rows:
        positions, goal = seen[:, : POSITIONS.size], seen[:, POSITIONS.size :]
        expected = skills.skills.actions(before, positions, skills.skills.towards(positions, goal))
        np.testing.assert_array_equal(player.act_deterministic(seen), expected)
        before = positions


class TestBadInput:
    @pytest.fixture
    def registry(self, tmp_path):
        registry = Registry(tmp_path / "registry")
        publish(registry, CONFIG, parameters(), {"env_steps": 100.0})
        return registry.root

    def test_skills_and_primitives_where_the_other_is_expected(self, champion):
        with pytest.raises(TandemError, match=r"made@1 is a set of skills of lsd; the method ours needs primitives"):
            check_fits(TASK_METHODS["ours"], made())
        with pytest.raises(TandemError, match=r"this method acts by skills, and panda-cube@.* has none"):
            check_fits(TASK_METHODS["lsd"], champion)

    def test_skills_of_another_method(self):
        with pytest.raises(
            TandemError, match=r"made@1 holds skills of dads, this method takes those of lsd; any-skills takes all"
        ):
            check_fits(TASK_METHODS["lsd"], made("dads"))

    def test_skills_of_another_robot(self, registry):
        trained = service.load("made", registry)
        spaces = {**trained.manifest.spaces, "action": 7}
        other = dataclasses.replace(trained, manifest=trained.manifest.model_copy(update={"spaces": spaces}))
        with pytest.raises(
            TandemError, match=r"made@1 is for another robot or layout: action 7; this one has action 4"
        ):
            check_fits(TASK_METHODS["lsd"], other)

    def test_another_size_of_z(self, skills):
        rows = np.zeros((NUM, POSITIONS.size), dtype=np.float32)
        with pytest.raises(TandemError, match=r"skill: expected shape \(N, 4\), got \(3, 2\)"):
            skills.skills.actions(rows, rows, np.zeros((NUM, 2), dtype=np.float32))
