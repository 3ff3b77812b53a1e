"""Skill discovery as a whole: on a point mass, where it has to find skills that differ, and in worlds."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from service.config import parse_config
from service.config.skills import SKILLS_OF, SkillsConfig, SkillsSACConfig
from service.envs.observations import POSITIONS
from service.learner.off_policy import OffPolicyLoop
from service.learner.replay import ReplayBuffer
from service.learner.sac import SACLearner
from service.learner.sac_networks import GaussianActor
from service.methods.rewards import find_reward
from service.methods.skill_learning import IntrinsicBatches, Seen, make_skill_loop, see_object
from service.policies.frozen_skills import draw_skills

NUM, LENGTH, STEP_M = 32, 10, 0.2
OBJECT = POSITIONS["object"]


class PointMasses:
    """Points in a plane that an action moves; the reward sees where they are."""

    def __init__(self, method):
        self._rng, self._method = np.random.default_rng(0), method
        self.at, self.elapsed = np.zeros((NUM, 2), np.float32), 0
        self.skill = draw_skills(SKILLS_OF[method][0], NUM, 2, self._rng)

    def inputs(self):
        return np.concatenate((self.at, self.skill), axis=1)

    def step(self, actions):
        after = self.at + np.float32(STEP_M) * actions
        columns = {"before": self.at, "after": after, "skill": self.skill, "action": actions}
        self.elapsed += 1
        ended = np.full(NUM, self.elapsed % LENGTH == 0)
        self.at = np.where(ended[:, None], np.float32(0.0), after)
        if ended.all():
            self.skill = draw_skills(SKILLS_OF[self._method][0], NUM, 2, self._rng)
        return columns, ended


def see(rows):
    ends = rows["before"], rows["after"]
    return Seen(*ends, np.ones(len(ends[0]), bool), *(np.concatenate((at, rows["skill"]), axis=1) for at in ends))


def where_skills_lead(loop, skills):
    """(M, 2) ends of episodes with (M, 2) skills, by the mean action."""
    import torch

    at = np.zeros_like(skills)
    for _ in range(LENGTH):
        with torch.no_grad():
            mean, _ = loop.learner.actor(torch.from_numpy(np.concatenate((at, skills), axis=1)))
        at = at + np.float32(STEP_M) * torch.tanh(mean).numpy()
    return at


@pytest.mark.parametrize("method", SKILLS_OF)
def test_skills_of_a_point_mass_differ(method):
    """A skill leads somewhere else than others do: its end tells which of the skills it was."""
    sac = SkillsSACConfig(
        num_worlds=NUM, gradient_steps=4, batch_size=128, hidden_sizes=(64, 64), learning_rate=1e-3, gamma=0.9,
        tau=0.02, learning_starts=640,
    )  # fmt: skip
    config = SkillsConfig(
        method=method, size=2, hidden_sizes=(64, 64), learning_rate=1e-3, num_alternatives=20, dual_initial=3.0, sac=sac
    )
    reward = find_reward(config.method, {})(config, 2, 0)
    learner = SACLearner(GaussianActor(4, 2, (64, 64)), 4, 2, sac, 0, 2 if reward.pays_features else None)
    replay = ReplayBuffer(1000, NUM, {"before": 2, "after": 2, "skill": 2, "action": 2})
    loop = OffPolicyLoop(PointMasses(method), replay, learner, IntrinsicBatches(reward, config, see), 0)
    loop.play(NUM * (60 if method in ("lsd", "metra") else 100))  # the last bits must not decide
    skills = np.repeat(draw_skills(SKILLS_OF[method][0], 12, 2, np.random.default_rng(1)), 3, axis=0)
    skills = skills + np.float32(0.02) * np.random.default_rng(2).standard_normal(skills.shape, dtype=np.float32)
    ends = where_skills_lead(loop, skills)
    assert np.linalg.norm(ends, axis=1).mean() > 0.5  # of 2 m at most, along an axis
    # Ends are about linear in z: directions of skills are directions in the plane, all around.
    fit, *_ = np.linalg.lstsq(np.column_stack((skills, np.ones(len(skills)))), ends, rcond=None)
    left = ends - np.column_stack((skills, np.ones(len(skills)))) @ fit
    explained = 1.0 - left.var(axis=0) / ends.var(axis=0)
    assert explained.min() > 0.5
    if method != "dads":  # its skills may differ along one line: it is paid for far ends, not for all sides
        assert abs(np.linalg.det(fit[:2])) > 0.05


@pytest.mark.parametrize("method", SKILLS_OF)
def test_losing_the_object_gives_back_what_moving_it_has_earned(method):
    """It is seen where the episode began. The network learns from steps alone, and so is DADS paid."""
    config = small_config(method=method).skills
    reward = find_reward(config.method, {})(config, 3, 0)
    start, edge, gone = (0.0, 0.05, 0.025), (0.12, 0.05, 0.025), (0.3, 0.05, -2.0)
    places = np.float32([start, edge, gone, gone])  # after each of three steps
    rows = {name: np.zeros((3, 11), np.float32) for name in ("previous", "positions", "following")}
    rows["positions"][:, 5:8], rows["following"][:, 5:8] = places[:-1], places[1:]
    rows |= {"start": np.tile(places[0], (3, 1)), "skill": np.ones((3, 4), np.float32), "action": np.zeros((3, 4))}
    workspace = parse_config({}, where="a test").world.workspace
    seen = see_object(rows, workspace)
    at = [(np.float32(place) - [0, 0, 0.15]) / 0.12 for place in (start, edge)]
    np.testing.assert_allclose(seen.before, [at[0], at[1], at[0]], atol=1e-5)
    np.testing.assert_allclose(seen.after, [at[1], at[0], at[0]], atol=1e-5)
    np.testing.assert_array_equal(seen.stepped, [True, False, False])
    learned, paid = [], []
    reward.learn = lambda *tensors: learned.append(tensors) or 0.0
    pay = reward.rewards
    reward.rewards = lambda *tensors: paid.append(tensors) or pay(*tensors)
    batches = IntrinsicBatches(reward, config, lambda rows: see_object(rows, workspace))
    replay = ReplayBuffer(1, 3, {name: values.shape[1] for name, values in rows.items()})
    replay.add({name: values.astype(np.float32) for name, values in rows.items()}, np.zeros(3, bool))
    batch = batches(replay, 200, np.random.default_rng(0))
    for before, after, _ in learned:  # nothing jumps
        assert {0.0, 1.0} == set(np.round(abs(after - before).numpy().max(axis=1), 4).tolist())
        assert (before[(after != before).any(1)][:, 0] == 0.0).all()
    way = np.round((paid[0][1] - paid[0][0]).numpy()[:, 0], 4)
    assert set(way.tolist()) == ({0.0, 1.0} if method == "dads" else {0.0, 1.0, -1.0})
    if method in ("lsd", "metra"):
        earned, lost = (batch.rewards[way == sign][0] for sign in (1.0, -1.0))
        assert earned == pytest.approx(-lost)
        assert earned != 0.0


def test_the_newest_steps_of_a_buffer_are_drawn_alone():
    replay = ReplayBuffer(10, 2, {"number": 1})
    for number in range(25):
        replay.add({"number": np.full((2, 1), number, np.float32)}, np.zeros(2, bool))
    rng = np.random.default_rng(0)
    assert set(replay.read(replay.draw(400, rng, newest=3))["number"].ravel()) == {22.0, 23.0, 24.0}
    assert set(replay.read(replay.draw(400, rng, newest=99))["number"].ravel()) == set(range(15, 25))
    assert set(replay.read(replay.draw(400, rng))["number"].ravel()) == set(range(15, 25))


def small_config(**skills):
    sac = {"num_worlds": 4, "gradient_steps": 2, "batch_size": 16, "learning_starts": 100, "hidden_sizes": [8]}
    tree = {"method": "lsd", "episode_steps": 10, "hidden_sizes": [8], "batch_size": 8, "sac": sac, **skills}
    world = {"physics_step_s": 0.005, "num_substeps": 8}
    run = {"total_env_steps": 400}
    return parse_config({"method": "skills", "skills": tree, "world": world, "run": run}, where="a test")


def test_the_network_may_learn_from_the_newest_steps_alone_and_the_policy_from_all():
    config = small_config(newest_steps=12, gradient_steps=2).skills
    asked, one = [], np.zeros((1, 4), np.float32)
    replay = SimpleNamespace(
        num_worlds=3,
        draw=lambda size, rng, newest=None: asked.append((size, newest)),
        read=lambda drawn: {"skill": one, "action": one},
    )
    place = np.zeros((1, 3), np.float32)
    seen = SimpleNamespace(before=place, after=place, stepped=np.ones(1, bool), inputs=None, next_inputs=None)
    reward = SimpleNamespace(
        learn=lambda *given: 0.0, rewards=lambda *given: torch.zeros(1), pays_jumps=True, pays_features=False
    )
    IntrinsicBatches(reward, config, lambda rows: seen)(replay, 64, np.random.default_rng(0))
    assert asked == [(8, 4), (8, 4), (64, None)]  # 12 steps of 3 worlds are 4 of each


@pytest.mark.parametrize("method", SKILLS_OF)
def test_a_loop_in_worlds_goes_on_bit_for_bit(method):
    loops = [make_skill_loop(small_config(method=method))[0] for _ in range(2)]
    first, second = loops
    first.play(150)
    second.load_state(*first.state())
    second.make_batch.reward.load_state(first.make_batch.reward.state())
    for loop in loops:
        loop.play(60)
    for one, other in ((loop.state()[0] for loop in loops), (loop.make_batch.reward.state() for loop in loops)):
        assert one.keys() == other.keys()
        assert all(np.array_equal(array, other[name]) for name, array in one.items())
    assert first.num_updates > 0
    for loop in loops:
        loop.worlds.close()


def test_a_skill_lasts_an_episode():
    loop, *_ = make_skill_loop(small_config())
    loop.play(80)
    skill = loop.replay.state()["skill"]
    assert skill.shape == (20, 4, 4)
    assert (skill[:10] == skill[0]).all()
    assert (skill[10:] == skill[10]).all()
    assert (skill[0] != skill[10]).all()
    assert (skill[0, 0] != skill[0, 1]).all()
    loop.worlds.close()


def test_where_the_object_was_at_its_highest_is_told_of_each_episode():
    _, worlds, _ = make_skill_loop(small_config())
    rng, places = np.random.default_rng(0), [worlds.positions[:, OBJECT]]
    while not worlds.finished:
        rows, _ = worlds.step(rng.uniform(-1.0, 1.0, (worlds.num_worlds, 4)).astype(np.float32))
        places.append(rows["following"][:, OBJECT])
    way = np.stack(places, axis=1)
    first_highest = way[np.arange(len(way)), way[..., 2].argmax(axis=1)]
    np.testing.assert_array_equal(worlds.finished, np.stack((way[:, 0], first_highest, way[:, -1]), axis=1))
    worlds.close()


def test_rewards_see_the_object_alone():
    loop, *_ = make_skill_loop(small_config())
    loop.play(80)
    batch = loop.make_batch(loop.replay, 64, np.random.default_rng(0))
    assert len(loop.make_batch.losses) == 2
    assert batch.inputs.shape == batch.next_inputs.shape == (64, 21)
    rng = np.random.default_rng(0)
    for _ in range(2):  # the reward's own batches
        loop.replay.draw(8, rng)
    rows = loop.replay.read(loop.replay.draw(64, rng))
    moved = np.abs(rows["following"] - rows["positions"])[:, 5:8].max(1) > 1e-5
    assert 0.0 < moved.mean() < 1.0
    seen = loop.make_batch._see(rows)
    assert seen.before.shape == (64, 3)
    assert seen.stepped.all()
    np.testing.assert_allclose(seen.before, (rows["positions"][:, 5:8] - [0, 0, 0.15]) / 0.12, atol=1e-5)
    np.testing.assert_array_equal(np.abs(seen.before - seen.after).max(1) > 1e-5 / 0.12, moved)
    paid = loop.make_batch.reward.rewards(*map(torch.from_numpy, (seen.before, seen.after, rows["skill"])))
    np.testing.assert_allclose(batch.rewards, paid.numpy(), rtol=1e-5)
    loop.worlds.close()


def test_a_setting_of_the_learner_leaves_the_others_as_skill_discovery_has_them():
    sac = SkillsConfig(sac={"num_worlds": 4}).sac
    assert sac == SkillsConfig().sac.model_copy(update={"num_worlds": 4})
    assert sac.gamma == 0.98
    assert not sac.critic_layer_norm
