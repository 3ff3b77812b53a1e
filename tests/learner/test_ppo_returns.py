import numpy as np
import pytest
import torch

from service.learner.diagnostics import explained_variance
from service.learner.ppo import advantages
from tests.learner.rollouts import DEVICE

GAMMA, LAMBDA = 0.9, 0.5


def gae(rewards, values, final_values, active, terminated):
    numbers = [torch.tensor(each, dtype=torch.float64, device=DEVICE) for each in (rewards, values, final_values)]
    masks = [torch.tensor(each, dtype=torch.bool, device=DEVICE) for each in (active, terminated)]
    return advantages(*numbers, *masks, gamma=GAMMA, gae_lambda=LAMBDA).cpu()


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
    assert advantages(zeros, zeros, zeros[0], mask, mask, gamma=0.9, gae_lambda=0.9).dtype == torch.float32


def test_explained_variance():
    returns = torch.tensor([1.0, 2.0, 3.0], device=DEVICE)
    assert explained_variance(returns, returns) == 1.0
    assert explained_variance(returns, torch.full_like(returns, 5.0)) == pytest.approx(0.0)
    assert explained_variance(torch.ones_like(returns), returns) == 0.0
