"""Losses, returns and metrics of PPO, by hand."""

import math

import numpy as np
import pytest
import torch

from service.config.self_play import MCPConfig
from service.learner import ppo
from service.learner.diagnostics import composition_metrics, explained_variance, probes
from service.policies.networks import MCPPolicy
from tests.learner.rollouts import DEVICE

LN2 = math.log(2.0)
GAMMA, LAMBDA = 0.9, 0.5


def surrogate(log_ratios, advantages, clip=0.2, dual_clip=3.0):
    log_prob = torch.tensor(log_ratios, requires_grad=True)
    loss, clip_fraction = ppo.clipped_surrogate(
        log_prob, torch.zeros(len(log_ratios)), torch.tensor(advantages), clip, dual_clip
    )
    loss.backward()
    return loss.item(), clip_fraction.item(), log_prob.grad.tolist()


@pytest.mark.parametrize(
    ("log_ratio", "advantage", "loss", "gradient"),
    [
        (0.0, 2.0, -2.0, -2.0),
        (math.log(1.1), 2.0, -2.2, -2.2),
        (LN2, 2.0, -2.4, 0.0),  # too likely already: clipped at 1.2
        (-LN2, 2.0, -1.0, -1.0),  # too unlikely but good: not clipped
        (-LN2, -2.0, 1.6, 0.0),  # unlikely enough: clipped at 0.8
        (LN2, -2.0, 4.0, 4.0),  # likely and bad: not clipped
        (2 * LN2, -2.0, 6.0, 0.0),  # likelier than the dual clip of 3
    ],
)
def test_surrogate_of_one_action(log_ratio, advantage, loss, gradient):
    actual_loss, clip_fraction, gradients = surrogate([log_ratio], [advantage])
    assert actual_loss == pytest.approx(loss, rel=1e-5)
    assert gradients == pytest.approx([gradient], rel=1e-5)
    assert clip_fraction == float(abs(math.exp(log_ratio) - 1.0) > 0.2)


def test_surrogate_is_a_mean():
    loss, clip_fraction, _ = surrogate([0.0, LN2, 0.0, 0.0], [1.0, 1.0, -1.0, 3.0])
    assert loss == pytest.approx(-(1.0 + 1.2 - 1.0 + 3.0) / 4)
    assert clip_fraction == 0.25


@pytest.mark.parametrize("log_ratio", [1e4, -1e4, 150.0])
@pytest.mark.parametrize("advantage", [1.0, -1.0])
def test_extreme_log_ratios_stay_finite(log_ratio, advantage):
    loss, _, gradients = surrogate([log_ratio], [advantage])
    assert math.isfinite(loss)
    assert all(math.isfinite(gradient) for gradient in gradients)
    log_prob = torch.tensor([log_ratio], requires_grad=True)
    cloning = ppo.cloning_loss(log_prob, torch.zeros(1), 0.2)
    cloning.backward()
    assert torch.isfinite(cloning)
    assert torch.isfinite(log_prob.grad).all()


def test_cloning_clips_only_what_became_likelier():
    log_prob = torch.tensor([math.log(1.1), math.log(1.3), -LN2], requires_grad=True)
    loss = ppo.cloning_loss(log_prob, torch.zeros(3), clip=0.2)
    loss.backward()
    assert loss.item() == pytest.approx(-(1.1 + 1.2 + 0.5) / 3)
    assert log_prob.grad.tolist() == pytest.approx([-1.1 / 3, 0.0, -0.5 / 3])


def test_value_loss_is_half_the_mean_squared_error():
    assert ppo.value_loss(torch.tensor([1.0, 2.0]), torch.tensor([0.0, 4.0])).item() == pytest.approx(1.25)


def gae(rewards, values, final_values, active, terminated):
    numbers = [torch.tensor(each, dtype=torch.float64, device=DEVICE) for each in (rewards, values, final_values)]
    masks = [torch.tensor(each, dtype=torch.bool, device=DEVICE) for each in (active, terminated)]
    return ppo.advantages(*numbers, *masks, gamma=GAMMA, gae_lambda=LAMBDA).cpu()


def column(*steps):
    return [[step] for step in steps]


def test_terminated_turn_does_not_bootstrap():
    # d2 = 1 - 0.3 = 0.7; d1 = 0.9 * 0.3 - 0.2 = 0.07; d0 = 0.9 * 0.2 - 0.1 = 0.08; A_t = d_t + 0.45 A_{t+1}
    result = gae(column(0, 0, 1), column(0.1, 0.2, 0.3), [100.0], column(1, 1, 1), column(0, 0, 1))
    np.testing.assert_allclose(result, column(0.08 + 0.45 * 0.385, 0.07 + 0.45 * 0.7, 0.7), atol=1e-12)


def test_timed_out_turn_bootstraps_from_the_final_value():
    # d2 = 0.9 * 2 - 0.3 = 1.5
    result = gae(column(0, 0, 0), column(0.1, 0.2, 0.3), [2.0], column(1, 1, 1), column(0, 0, 0))
    np.testing.assert_allclose(result, column(0.08 + 0.45 * 0.745, 0.07 + 0.45 * 1.5, 1.5), atol=1e-12)


def test_short_turns_bootstrap_behind_their_own_last_step():
    # World 0 times out after its first step: 0.9 * 2 - 0.1 = 1.7. World 1 terminates: 1 - 0.2; 0.08 + 0.45 * 0.8.
    # World 2 has no turn. Values and rewards behind the last step must not matter.
    result = gae(
        [[0, 0, 9], [9, 1, 9], [9, 9, 9]],
        [[0.1, 0.1, 7], [7, 0.2, 7], [7, 7, 7]],
        [2.0, 100.0, 100.0],
        [[1, 1, 0], [0, 1, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 1, 0], [0, 0, 0]],
    )
    np.testing.assert_allclose(result, [[1.7, 0.44, 0], [0, 0.8, 0], [0, 0, 0]], atol=1e-12)


def test_float32_stays_float32():
    zeros, mask = torch.zeros((2, 3)), torch.ones((2, 3), dtype=torch.bool)
    assert ppo.advantages(zeros, zeros, zeros[0], mask, mask, gamma=0.9, gae_lambda=0.9).dtype == torch.float32


def test_explained_variance():
    returns = torch.tensor([1.0, 2.0, 3.0], device=DEVICE)
    assert explained_variance(returns, returns) == 1.0
    assert explained_variance(returns, torch.full_like(returns, 5.0)) == pytest.approx(0.0)
    assert explained_variance(torch.ones_like(returns), returns) == 0.0


def test_composition_metrics_of_constant_primitives():
    # Variances 1/4 and 1 under weights 0.25 and 0.75: precisions 1 and 0.75, composite variance 1 / 1.75.
    torch.manual_seed(0)
    bob = MCPPolicy(
        MCPConfig(num_primitives=2, trunk_hidden_sizes=(4,), primitive_hidden_size=4, gate_hidden_sizes=(4,))
    )
    bob.gate.forward = lambda observation: torch.tensor([0.25, 0.75]).expand(len(observation), 2)
    variances = torch.tensor([0.25, 1.0])[:, None].expand(2, 4)
    bob.primitives.forward = lambda positions: (
        torch.zeros(len(positions), 2, 4),
        variances.expand(len(positions), 2, 4),
    )
    metrics = composition_metrics(bob, torch.zeros(5, 14))
    assert metrics == pytest.approx(
        {
            "bob_std": 1.75**-0.5,
            "primitive_weight_0": 0.25,
            "primitive_weight_1": 0.75,
            "primitive_share_0": 1.0 / 1.75,
            "primitive_share_1": 0.75 / 1.75,
        }
    )


def test_probes_are_spread_over_all_rows():
    assert probes(1024).tolist() == list(range(1024))
    assert probes(1025).tolist() == list(range(0, 1025, 2))
    assert len(probes(100_000)) <= 1024
