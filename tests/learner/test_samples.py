import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from service.config.self_play import ABCConfig, PPOConfig
from service.envs.observations import ACTION, BOB, PAPER
from service.learner.player import Player
from service.learner.ppo import advantages, collect
from service.learner.samples import (
    DemonstrationRows,
    draw_epoch,
    reflect_at_random,
)
from tests.learner.rollouts import make_turns, nobody_learns

CPU = torch.device("cpu")
CONFIG = PPOConfig()


def make_bob_turns(seed=0, **overrides):
    return make_turns(np.random.default_rng(seed), BOB.size, PAPER.bob_value.size, **overrides)


class Estimate(nn.Module):
    def forward(self, value_observation):
        return 3.0 * value_observation[:, 0] + value_observation[:, 1]


class Zero(nn.Module):
    def forward(self, value_observation):
        return torch.zeros(len(value_observation))


class Policy(nn.Module):
    def forward(self, observation):
        mean = observation[:, 1:2].expand(-1, ACTION.size)
        return mean, torch.full_like(mean, 2.0)


PLAYER = Player(Policy(), Estimate(), CONFIG, CPU)


def test_only_active_steps_of_learnable_worlds_become_samples():
    learn = np.array([True, False] * 4)
    turns = make_bob_turns(learn=learn)
    samples = collect([turns], PLAYER)
    kept = turns.active & learn
    assert len(samples) == kept.sum() > 0
    order = np.argwhere(kept)
    np.testing.assert_array_equal(samples.action, [turns.action[step, world] for step, world in order])
    np.testing.assert_array_equal(samples.behaviour_log_prob, [turns.log_prob[step, world] for step, world in order])
    np.testing.assert_array_equal(samples.proximal_mean[:, 3], samples.observation[:, 1])
    standard = (samples.action - samples.proximal_mean) / 2.0
    expected = -(0.5 * standard.square() + math.log(2.0) + 0.5 * math.log(2.0 * math.pi)).sum(1)
    np.testing.assert_allclose(samples.proximal_log_prob, expected, rtol=1e-5)


def test_targets_are_advantages_plus_values():
    turns = make_bob_turns()
    samples = collect([turns], PLAYER)
    names = "reward", "active", "terminated", "value_observation", "final_value_observation"
    reward, active, terminated, *observed = (torch.from_numpy(getattr(turns, name)) for name in names)
    values, final = (PLAYER.value(each.flatten(0, -2)) for each in observed)
    grid = values.view(reward.shape)
    arrays = reward, grid, final, active, terminated
    expected = advantages(*arrays, gamma=CONFIG.gamma, gae_lambda=CONFIG.gae_lambda)[active]
    np.testing.assert_allclose(samples.value_target, expected + grid[active], atol=1e-6)
    standard = (expected - expected.mean()) / expected.std(correction=0)
    np.testing.assert_allclose(samples.advantage, standard, atol=1e-5)


def test_several_rollouts_are_joined_along_worlds():
    first, second = make_bob_turns(0), make_bob_turns(1)
    joined = collect([first, second], PLAYER)
    assert len(joined) == first.active.sum() + second.active.sum()
    apart = [collect([turns], PLAYER).value_target for turns in (first, second)]
    np.testing.assert_allclose(np.sort(joined.value_target), np.sort(np.concatenate(apart)), atol=1e-6)


def test_no_samples_at_all():
    idle = make_bob_turns(active=np.zeros_like(make_bob_turns().active))
    assert collect([idle, nobody_learns(make_bob_turns())], PLAYER) is None


def test_equal_advantages_become_zero():
    turns = make_bob_turns()
    constant = replace(turns, reward=np.full_like(turns.reward, 0.1), terminated=turns.active)
    samples = collect([constant], Player(Policy(), Zero(), CONFIG, CPU))
    np.testing.assert_array_equal(samples.advantage, np.zeros(len(samples)))


def test_half_of_the_samples_are_reflected_at_random():
    samples = collect([make_bob_turns()], PLAYER)
    mixed = reflect_at_random(samples, PAPER, PLAYER, np.random.default_rng(0))
    chosen = np.random.default_rng(0).random(len(samples)) < 0.5
    assert 0.3 < chosen.mean() < 0.7
    for before, after in zip(samples.columns(), mixed.columns(), strict=True):
        assert torch.equal(after[~chosen], before[~chosen])
    mirrors = {"observation": BOB.mirror, "value_observation": PAPER.bob_value.mirror, "action": ACTION.mirror}
    for name, each in mirrors.items():
        np.testing.assert_array_equal(getattr(mixed, name)[chosen], each(getattr(samples, name)[chosen].numpy()))
    for name in ("advantage", "value_target", "value", "behaviour_log_prob"):
        assert torch.equal(getattr(mixed, name), getattr(samples, name))
    # The policy is asked at the reflected observation, whose y changes its sign.
    np.testing.assert_array_equal(mixed.proximal_mean[chosen, 0], -samples.observation[chosen, 1])


def places(epoch, part):
    return np.concatenate([minibatch[part] for minibatch in epoch])


def draw(num_samples, num_demonstrations, **abc):
    config = CONFIG.model_copy(update={"minibatch_size": 8})
    return draw_epoch(num_samples, num_demonstrations, config, ABCConfig(**abc), np.random.default_rng(0))


def test_an_epoch_has_every_sample_once():
    for num, parts in ((20, 2), (21, 3), (3, 1), (11, 1), (13, 2)):
        epoch = draw(num, 0)
        assert len(epoch) == parts
        assert sorted(places(epoch, 0)) == list(range(num))
        assert list(places(epoch, 0)) != list(range(num))
        assert places(epoch, 1).size == 0


def test_demonstrations_are_cycled_through():
    epoch = draw(40, 6)
    assert [len(cloned) for _, cloned in epoch] == [4] * 5
    counts = np.bincount(places(epoch, 1), minlength=6)
    assert counts.min() >= 3
    assert counts.max() <= 4


@pytest.mark.parametrize(("rows_per_sample", "num"), [(0.25, 2), (1.0, 8), (0.01, 1)])
def test_demonstrations_of_a_minibatch_follow_the_configuration(rows_per_sample, num):
    assert [len(cloned) for _, cloned in draw(40, 100, rows_per_sample=rows_per_sample)] == [num] * 5


def test_few_demonstrations_are_not_repeated_within_a_minibatch():
    assert all(sorted(cloned) == [0, 1] for _, cloned in draw(16, 2))


def test_demonstrations_alone_make_an_epoch():
    epoch = draw(0, 12)
    assert [len(own) for own, _ in epoch] == [0, 0, 0]
    assert sorted(places(epoch, 1)) == list(range(12))


def test_only_demonstrations_that_are_drawn_are_reflected_and_asked_for():
    rng = np.random.default_rng(0)
    observation, action = (rng.standard_normal((5, size)).astype(np.float32) for size in (BOB.size, ACTION.size))
    rows = DemonstrationRows(torch.from_numpy(observation), torch.from_numpy(action), mirror=PAPER.bob.mirror)
    assert len(rows) == 10
    cloning = rows.to_clone(np.array([1, 4, 6]), PLAYER)  # 6 is the reflection of row 1
    assert len(cloning) == 3
    np.testing.assert_array_equal(cloning.observation[:2], observation[[1, 4]])
    np.testing.assert_array_equal(cloning.observation[2], BOB.mirror(observation[1]))
    np.testing.assert_array_equal(cloning.action[2], ACTION.mirror(action[1]))
    expected = PLAYER.log_prob(cloning.observation, cloning.action)
    np.testing.assert_array_equal(cloning.proximal_log_prob, expected)
    minibatch = cloning.take(np.array([2, 0, 2]))
    assert torch.equal(minibatch.action, cloning.action[[2, 0, 2]])
