import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from service.base.liveness import work_done
from service.config.self_play import ABCConfig, PPOConfig
from service.learner import ppo
from service.learner.player import Player
from service.learner.ppo import MAX_NON_FINITE, train
from service.learner.samples import DemonstrationRows, Samples

CPU = torch.device("cpu")
CONFIG = PPOConfig(learning_rate=0.01, num_epochs=4, minibatch_size=32, target_kl=0.05, max_grad_norm=10.0)
ABC = ABCConfig()


class Bandit(nn.Module):
    """A Gaussian with one mean and one std, whatever it sees."""

    def __init__(self):
        super().__init__()
        self.mean = nn.Parameter(torch.zeros(1))
        self.log_std = nn.Parameter(torch.full((1,), -0.5))

    def forward(self, observation):
        nothing = torch.zeros_like(observation)  # added so that the outputs are no views of the parameters
        return nothing + self.mean, nothing + self.log_std.exp()


class Constant(nn.Module):
    def __init__(self):
        super().__init__()
        self.level = nn.Parameter(torch.zeros(1))

    def forward(self, observation):
        return torch.zeros(len(observation)) + self.level


def make_player(**overrides):
    return Player(Bandit(), Constant(), CONFIG.model_copy(update=overrides), CPU)


@torch.no_grad()
def play(player, rng, num=128, target=0.8):
    """One-step turns, paid by how close the action comes to ``target``."""
    observation = torch.zeros(num, 1)
    mean, std = player.policy(observation)
    action = mean + std * torch.from_numpy(rng.standard_normal((num, 1)).astype(np.float32))
    reward = -(action[:, 0] - target).square()
    advantage = (reward - reward.mean()) / reward.std()
    log_prob = player.log_prob(observation, action)
    value = player.value(observation)
    return Samples(observation, observation, action, log_prob, mean, std, advantage, reward, value)


@torch.no_grad()
def make_cloning(player, action=0.5, num=64):
    return DemonstrationRows(torch.zeros(num, 1), torch.full((num, 1), action))


def update(player, samples=None, cloning=None, seed=0):
    return ppo.update(player, samples, cloning, ABC, np.random.default_rng(seed))


def parameters(player):
    return {name: array for name, array in player.state().items() if not name.startswith(("adam/", "learning_rate"))}


def assert_same(first, second):
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


def assert_undone(metrics, player, before):
    """All but the learning rate, which fell, is as it was."""
    assert metrics["rollbacks"] == 1.0
    after = player.state()
    assert after.pop("learning_rate") == pytest.approx(before.pop("learning_rate") / 1.5)
    assert_same(after, before)


def test_a_bandit_is_learned():
    player, rng = make_player(), np.random.default_rng(0)
    levels = []
    for _ in range(30):
        assert update(player, play(player, rng))["rollbacks"] == 0.0
        levels.append(player.value.level.item())
    assert player.policy.mean.item() == pytest.approx(0.8, abs=0.1)
    assert player.policy.log_std.item() < -1.0
    assert min(levels) < -0.1  # the mean reward, about -1 at first ...
    assert levels[-1] == pytest.approx(0.0, abs=0.05)  # ... and about 0 in the end


def test_cloning_makes_demonstrations_likelier_without_samples():
    player = make_player()
    cloning = make_cloning(player)
    with torch.no_grad():
        before = player.log_prob(cloning.observation, cloning.action)
    metrics = update(player, cloning=cloning)
    assert (player.log_prob(cloning.observation, cloning.action) > before + 0.01).all()
    assert metrics["cloning_loss"] < -1.0
    assert "policy_loss" not in metrics
    assert player.value.level.item() == 0.0


@pytest.mark.parametrize("weight", [0.25, 1.0])
@pytest.mark.parametrize("beside_samples", [False, True])
def test_cloning_has_its_weight(weight, beside_samples):
    player = make_player(num_epochs=1)
    samples = play(player, np.random.default_rng(0), num=32) if beside_samples else None
    if samples is not None:
        samples = replace(samples, advantage=torch.zeros_like(samples.advantage))  # only cloning moves the mean
    abc = ABCConfig(weight=weight)
    ppo.update(player, samples, make_cloning(player, num=16), abc, np.random.default_rng(0))
    # Of a Gaussian with mean 0 and std e^-0.5, d log p(0.5) / d mean is 0.5 e; Adam's moment is 0.1 x the gradient.
    moment = player.state()["adam/first_moment/policy/mean"]
    np.testing.assert_allclose(moment, [-0.1 * weight * 0.5 * math.e], rtol=1e-5)


@pytest.mark.parametrize("mean_only", [False, True])
def test_cloning_of_the_mean_only_leaves_the_std_alone(mean_only):
    player = make_player(num_epochs=1)
    abc = ABCConfig(mean_only=mean_only)
    ppo.update(player, None, make_cloning(player, num=16), abc, np.random.default_rng(0))
    assert player.policy.mean.item() > 0.0
    assert (player.policy.log_std.item() == -0.5) == mean_only


def test_the_gradient_of_the_value_loss_by_hand():
    player = make_player(num_epochs=1)
    samples = play(player, np.random.default_rng(0), num=32)
    update(player, samples)
    # The values are 0, so the gradient of half the mean squared error is minus the mean target.
    moment = player.state()["adam/first_moment/value/level"]
    np.testing.assert_allclose(moment, [-0.1 * samples.value_target.mean().item()], rtol=1e-5)


def test_ratios_start_at_one():
    # Samples and demonstrations go through the policy together; each must meet its own old log-probability.
    player = make_player(learning_rate=1e-9)
    metrics = update(player, play(player, np.random.default_rng(0)), make_cloning(player))
    assert metrics["cloning_loss"] == pytest.approx(-1.0, abs=1e-5)
    assert metrics["policy_loss"] == pytest.approx(0.0, abs=1e-5)  # advantages have mean 0
    assert metrics["clip_fraction"] == 0.0


def test_entropy_bonus_widens_the_policy():
    player = make_player(entropy_weight=1.0)
    samples = play(player, np.random.default_rng(0))
    update(player, replace(samples, advantage=torch.zeros_like(samples.advantage)))
    assert player.policy.log_std.item() > -0.49


def test_gradients_are_clipped_network_by_network():
    player = make_player(num_epochs=1, max_grad_norm=0.01)
    metrics = update(player, play(player, np.random.default_rng(0), num=32))
    assert metrics["grad_norm"] > 0.1
    state = player.state()
    policy = [state[f"adam/first_moment/policy/{name}"] for name in ("mean", "log_std")]
    assert np.linalg.norm(policy) == pytest.approx(0.1 * 0.01, rel=1e-3)  # (1 - beta_1) x the clipped gradient
    assert np.linalg.norm(state["adam/first_moment/value/level"]) == pytest.approx(0.1 * 0.01, rel=1e-3)


def test_nothing_to_learn_from_changes_nothing():
    player = make_player()
    before = player.state()
    metrics = update(player)
    assert_same(player.state(), before)
    assert metrics == {"learning_rate": CONFIG.learning_rate, "non_finite_steps": 0.0, "rollbacks": 0.0}


def test_a_non_finite_minibatch_is_skipped():
    samples = play(make_player(), np.random.default_rng(0), num=32)
    broken = replace(samples, advantage=torch.full_like(samples.advantage, math.nan))
    player = make_player(num_epochs=2)
    before = player.state()
    metrics = update(player, broken)
    assert metrics["non_finite_steps"] == 2.0
    assert metrics["rollbacks"] == 0.0
    assert_same(parameters(player), {name: before[name] for name in parameters(player)})


def test_other_minibatches_go_on_beside_a_non_finite_one():
    samples = play(make_player(), np.random.default_rng(0))
    samples.advantage[5] = math.inf
    player = make_player(num_epochs=1)
    stats = train(player, samples, None, ABC, np.random.default_rng(0))
    assert stats.num_non_finite == 1
    assert len(stats.scalars["policy_loss"]) == 3
    assert all(np.isfinite(array).all() for array in player.state().values())
    assert player.policy.mean.item() != 0.0


def test_three_non_finite_minibatches_undo_the_update():
    player = make_player(num_epochs=1)
    samples = play(player, np.random.default_rng(0), num=32 * 8)
    update(player, samples)  # so that Adam has something to lose
    samples = play(player, np.random.default_rng(1), num=32 * 8)
    samples.advantage[::20] = math.nan
    before = player.state()
    metrics = update(player, samples)
    assert metrics["non_finite_steps"] == MAX_NON_FINITE
    assert_undone(metrics, player, before)


def test_a_collapse_is_undone():
    player = make_player(learning_rate=1.0, num_epochs=1)
    before = player.state()
    metrics = update(player, play(player, np.random.default_rng(0), num=32))
    assert metrics["kl"] > 10 * CONFIG.target_kl
    assert_undone(metrics, player, before)


def test_the_policy_stops_early_and_the_value_network_goes_on():
    player = make_player(learning_rate=0.05, num_epochs=10, target_kl=0.01)
    samples, before = play(player, np.random.default_rng(0), num=320), work_done()
    stats = train(player, samples, None, ABC, np.random.default_rng(0))
    assert work_done() - before == 100  # the learner is seen to go on
    assert stats.stopped
    assert 1 <= len(stats.scalars["policy_loss"]) < 50
    assert len(stats.scalars["value_loss"]) == 100
    steps = player.state()
    assert steps["adam/step/policy/mean"] == len(stats.scalars["policy_loss"])
    assert steps["adam/step/value/level"] == 100


def test_the_kl_that_stops_the_policy_is_this_epochs():
    player = make_player()
    stats = train(player, play(player, np.random.default_rng(0)), None, ABC, np.random.default_rng(0))
    assert len(stats.scalars["kl"]) == 16
    assert stats.kls == [float(kl) for kl in stats.scalars["kl"][-4:]]
    assert stats.passes(0.02, bound=np.mean([*stats.kls, 0.02]) - 1e-6)
    assert not stats.passes(math.nan, bound=np.mean(stats.kls) + 1e-6)


def test_a_policy_ahead_of_the_one_that_acted_does_not_stop():
    player = make_player(num_epochs=1)
    samples = play(player, np.random.default_rng(0))
    moved = torch.where(samples.action[:, 0] > 0.0, 0.9, -0.9)
    lagging = replace(samples, behaviour_log_prob=samples.behaviour_log_prob + moved)
    stats = train(player, lagging, None, ABC, np.random.default_rng(0))
    assert not stats.stopped
    assert stats.kls[0] == pytest.approx(0.0, abs=1e-6)
    assert torch.stack(stats.scalars["clip_fraction"]).mean() == 0.0  # the clip range is this update's own


def test_samples_of_a_lagging_policy_are_weighted_by_what_has_changed_since():
    weight = ppo.importance_weight(torch.tensor([0.0, 0.5, -0.5, 3.0]), torch.tensor([0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(weight, [1.0, math.exp(0.5), math.exp(-0.5), ppo.MAX_IMPORTANCE_WEIGHT], rtol=1e-6)


@pytest.mark.parametrize(
    ("target_kl", "num_updates", "multiple"),
    [(10.0, 1, 1.5), (10.0, 5, 2.0), (1e-9, 1, 1 / 1.5), (1e-9, 12, 0.03)],
)
def test_learning_rate_follows_the_kl_within_bounds(target_kl, num_updates, multiple):
    player, rng = make_player(target_kl=target_kl, num_epochs=1), np.random.default_rng(0)
    for _ in range(num_updates):
        update(player, play(player, rng, num=32))
    assert player.optimizer.learning_rate == pytest.approx(CONFIG.learning_rate * multiple)


@pytest.mark.parametrize(
    ("version", "multiple"),
    # of updates 3, 4, 8, 40: twice the rate, times 4 / number at most; of update 1,000 the lower bound
    [(2, 2.0), (3, 2.0), (7, 1.0), (39, 0.2), (999, 0.03)],
)
def test_a_player_that_settles_has_a_learning_rate_that_falls_with_the_number_of_updates(version, multiple):
    player, rng = make_player(target_kl=1e3, num_epochs=1, rate_decay_after_updates=4), np.random.default_rng(0)
    for _ in range(2):  # so small a KL raises it to the bound
        ppo.update(player, play(player, rng, num=32), None, ABC, np.random.default_rng(0), version=version)
    assert player.optimizer.learning_rate == pytest.approx(CONFIG.learning_rate * multiple)


def test_in_the_first_updates_the_value_network_alone_may_learn():
    player = make_player(value_first_updates=2)
    for version, moves in ((1, False), (2, True)):
        before = player.policy.mean.item()
        samples = play(player, np.random.default_rng(0))
        ppo.update(player, samples, make_cloning(player), ABC, np.random.default_rng(0), version=version)
        assert (player.policy.mean.item() != before) == moves


def test_an_update_that_was_stopped_early_lowers_the_learning_rate():
    # However small its KL is at last: a step that leaves most samples unused was too long.
    player = make_player(target_kl=1e-9, num_epochs=1)
    samples = play(player, np.random.default_rng(0))
    metrics = update(player, samples)
    assert metrics["policy_steps"] < len(samples) // player.config.minibatch_size
    assert player.optimizer.learning_rate == pytest.approx(CONFIG.learning_rate / 1.5)


@pytest.mark.parametrize(("decoupled", "loss", "clipped"), [(True, -1.5, 0.0), (False, -1.2, 1.0)])
def test_the_ratio_is_clipped_around_the_start_of_the_update_or_the_policy_that_acted(decoupled, loss, clipped):
    """The policy that acted gave these actions 1 / 1.5 of the density that the newest gives them."""
    player = make_player(num_epochs=1, learning_rate=1e-9, decoupled=decoupled)
    samples = play(player, np.random.default_rng(0), num=32)
    older = samples.behaviour_log_prob - math.log(1.5)
    steps = train(
        player,
        replace(samples, advantage=torch.ones(32), behaviour_log_prob=older),
        None,
        ABC,
        np.random.default_rng(0),
    )
    assert steps.scalars["policy_loss"][0].item() == pytest.approx(loss, rel=1e-5)
    assert steps.scalars["clip_fraction"][0].item() == clipped


def test_an_update_whose_kl_is_no_number_is_undone():
    """At this learning rate one step takes the std below what a float holds."""
    player = make_player(num_epochs=1, learning_rate=1e4)
    samples = play(player, np.random.default_rng(0), num=32)
    before = player.state()
    metrics = update(player, replace(samples, advantage=1.0 - (samples.action[:, 0] / 0.6065).square()))
    assert_undone(metrics, player, before)


def test_the_kl_is_from_the_policy_before_to_the_one_after():
    """By hand, of Gaussians: (0, e^-0.5) before, one step later (m, e^(l - 0.5))."""
    once, twice = (make_player(num_epochs=num, learning_rate=0.05) for num in (1, 2))
    samples = play(once, np.random.default_rng(0), num=32)
    train(once, samples, None, ABC, np.random.default_rng(0))
    mean, log_ratio = once.policy.mean.item(), once.policy.log_std.item() + 0.5
    expected = log_ratio + (1 + mean * mean * math.e) / (2 * math.exp(2 * log_ratio)) - 0.5
    assert train(twice, samples, None, ABC, np.random.default_rng(0)).kls == [pytest.approx(expected, rel=1e-3)]


def test_reported_kl_is_that_of_the_whole_update():
    player = make_player()
    samples = play(player, np.random.default_rng(0))
    mean, log_std = player.policy.mean.item(), player.policy.log_std.item()
    metrics = update(player, samples)
    new_mean, new_log_std = player.policy.mean.item(), player.policy.log_std.item()
    # KL of two Gaussians: ln(s1 / s0) + (s0^2 + (m0 - m1)^2) / (2 s1^2) - 1/2
    spread = math.exp(2 * log_std) + (mean - new_mean) ** 2
    expected = new_log_std - log_std + spread / (2 * math.exp(2 * new_log_std)) - 0.5
    assert metrics["kl"] == pytest.approx(expected, rel=1e-3)
