import math
from dataclasses import replace

import numpy as np
import torch
from torch import nn

from service.config import PPOConfig
from service.envs.observations import ACTION, BOB, BOB_VALUE
from service.learner.player import Player
from service.learner.ppo import advantages, collect
from service.learner.samples import Cloning, Samples, augment_by_symmetry, minibatches
from tests.learner.rollouts import make_turns, nobody_learns

CPU = torch.device("cpu")
CONFIG = PPOConfig()


def make_bob_turns(seed=0, **overrides):
    return make_turns(np.random.default_rng(seed), BOB.size, BOB_VALUE.size, **overrides)


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


def make_samples(num):
    index = torch.arange(num, dtype=torch.float32)
    return Samples(
        *(index[:, None].expand(num, 3) for _ in range(3)),
        index,
        *(index[:, None] for _ in range(2)),
        *(index for _ in range(3)),
    )


def make_cloning(num):
    index = torch.arange(num, dtype=torch.float32)
    return Cloning(index[:, None], index[:, None], index)


def test_only_active_steps_of_learnable_worlds_become_samples():
    learn = np.array([True, False] * 4)
    turns = make_bob_turns(learn=learn)
    samples = collect([[turns]], turns, PLAYER)
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
    samples = collect([[turns]], turns, PLAYER)
    values, final = (
        PLAYER.value(torch.from_numpy(each))
        for each in (turns.value_observation[turns.active], turns.final_value_observation)
    )
    grid = np.zeros(turns.active.shape, dtype=np.float32)
    grid[turns.active] = values.numpy()
    masks = turns.active, turns.terminated
    gae = advantages(turns.reward, grid, final.numpy(), *masks, gamma=CONFIG.gamma, gae_lambda=CONFIG.gae_lambda)
    expected = gae[turns.active]
    np.testing.assert_allclose(samples.value_target, expected + values.numpy(), atol=1e-6)
    np.testing.assert_allclose(samples.advantage, (expected - expected.mean()) / expected.std(), atol=1e-5)


def test_several_rollouts_are_joined_along_worlds():
    first, second = make_bob_turns(0), make_bob_turns(1)
    joined = collect([[first], [second]], first, PLAYER)
    assert len(joined) == first.active.sum() + second.active.sum()
    apart = [collect([[turns]], turns, PLAYER).value_target for turns in (first, second)]
    np.testing.assert_allclose(np.sort(joined.value_target), np.sort(np.concatenate(apart)), atol=1e-6)


def test_no_samples_at_all():
    idle = make_bob_turns(active=np.zeros_like(make_bob_turns().active))
    assert collect([[idle, nobody_learns(make_bob_turns())]], idle, PLAYER) is None


def test_equal_advantages_become_zero():
    turns = make_bob_turns()
    constant = replace(turns, reward=np.full_like(turns.reward, 0.1), terminated=turns.active)
    samples = collect([[constant]], constant, Player(Policy(), Zero(), CONFIG, CPU))
    np.testing.assert_array_equal(samples.advantage, np.zeros(len(samples)))


def test_samples_are_augmented_by_their_reflections():
    samples = collect([[make_bob_turns()]], make_bob_turns(), PLAYER)
    mirrors = BOB.mirror, BOB_VALUE.mirror, ACTION.mirror
    doubled = augment_by_symmetry(samples, PLAYER)
    num = len(samples)
    assert len(doubled) == 2 * num
    for before, after in zip(samples.tensors(), doubled.tensors(), strict=True):
        assert torch.equal(after[:num], before)
    names = "observation", "value_observation", "action"
    for name, mirror in zip(names, mirrors, strict=True):
        np.testing.assert_array_equal(getattr(doubled, name)[num:], mirror(getattr(samples, name).numpy()))
    for name in ("advantage", "value_target", "value"):
        assert torch.equal(getattr(doubled, name)[num:], getattr(samples, name))
    # The policy is asked at the reflected observation, whose y changes its sign.
    np.testing.assert_array_equal(doubled.proximal_mean[num:, 0], -samples.observation[:, 1])
    np.testing.assert_array_equal(doubled.behaviour_log_prob[num:], doubled.proximal_log_prob[num:])


def test_an_epoch_has_every_sample_once():
    for num, size, parts in ((20, 8, 2), (21, 8, 3), (3, 8, 1), (11, 8, 1), (13, 8, 2)):
        batches = minibatches(make_samples(num), None, size, np.random.default_rng(0))
        assert len(batches) == parts
        assert all(cloning is None for _, cloning in batches)
        seen = torch.cat([samples.value_target for samples, _ in batches])
        assert sorted(seen.tolist()) == list(range(num))
        assert seen.tolist() != list(range(num))
        assert all(torch.equal(samples.value_target, samples.observation[:, 0]) for samples, _ in batches)


def test_demonstrations_are_cycled_through():
    batches = minibatches(make_samples(40), make_cloning(6), 8, np.random.default_rng(0))
    drawn = [cloning.proximal_log_prob for _, cloning in batches]
    assert [len(each) for each in drawn] == [4] * 5
    counts = torch.cat(drawn).int().bincount(minlength=6)
    assert counts.min() >= 3
    assert counts.max() <= 4


def test_few_demonstrations_are_not_repeated_within_a_minibatch():
    batches = minibatches(make_samples(16), make_cloning(2), 8, np.random.default_rng(0))
    assert all(sorted(cloning.proximal_log_prob.tolist()) == [0.0, 1.0] for _, cloning in batches)


def test_demonstrations_alone_make_an_minibatches():
    batches = minibatches(None, make_cloning(12), 8, np.random.default_rng(0))
    assert [samples for samples, _ in batches] == [None] * 3
    assert sorted(torch.cat([cloning.proximal_log_prob for _, cloning in batches]).tolist()) == list(range(12))
    assert batches[0][1].action.shape == (4, 1)
