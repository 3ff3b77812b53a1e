"""Densities and products of diagonal Gaussians, against hand computation and numeric integration."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from service.policies.forward import compose
from service.policies.gaussian import entropy, kl, log_prob


def test_densities_by_hand() -> None:
    """One std away in the first component, at the mean in the second."""
    mean, std = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.5, 2.0]])
    expected = -0.5 - math.log(0.5) - math.log(2.0) - math.log(2.0 * math.pi)
    assert log_prob(torch.tensor([[1.5, 0.0]]), mean, std).tolist() == pytest.approx([expected])
    assert entropy(torch.tensor([[0.5, 3.0]])).tolist() == pytest.approx([math.log(1.5 * 2.0 * math.pi * math.e)])


def test_kl_by_hand() -> None:
    # KL(N(1, 2^2) || N(0, 1)) = (4 + 1 - 1 - ln 4) / 2; of N(1, 0.5^2) || N(1, 1) (0.25 - 1 + ln 4) / 2
    mean, std = torch.tensor([[1.0, 1.0]]), torch.tensor([[2.0, 0.5]])
    other, unit = torch.tensor([[0.0, 1.0]]), torch.ones(1, 2)
    assert kl(mean, std, other, unit).tolist() == pytest.approx([(4.0 - 0.75) / 2.0])
    assert kl(mean, std, mean, std).tolist() == [0.0]


def test_the_product_of_two_primitives_by_hand() -> None:
    # precisions: action 0: 0.5 / 0.25 = 2 and 1 / 0.5 = 2; action 1: 0.5 / 1 = 0.5 and 1 / 2 = 0.5
    # action 2: 0.5 / 0.1 = 5 and 1 / 1 = 1
    weights = np.array([0.5, 1.0])
    means = np.array([[1.0, -1.0, 0.6], [0.0, 3.0, -0.6]])
    variances = np.array([[0.25, 1.0, 0.1], [0.5, 2.0, 1.0]])
    mean, variance = compose(weights, means, variances)
    np.testing.assert_allclose(mean, [0.5, 1.0, (5 * 0.6 - 0.6) / 6], rtol=1e-14)
    np.testing.assert_allclose(variance, [0.25, 1.0, 1 / 6], rtol=1e-14)
    tensors = compose(torch.tensor(weights), torch.tensor(means), torch.tensor(variances))
    np.testing.assert_allclose(tensors[0].numpy(), mean, rtol=1e-14)
    np.testing.assert_allclose(tensors[1].numpy(), variance, rtol=1e-14)
    assert {each.dtype for each in compose(*map(np.float32, (weights, means, variances)))} == {np.dtype(np.float32)}


def test_it_agrees_with_the_integrated_product() -> None:
    weights, means, variances = np.array([0.3, 0.9, 0.05]), np.array([-0.7, 0.4, 1.9]), np.array([0.3, 0.5, 0.02])
    action = np.linspace(-12.0, 12.0, 20_001)
    log_product = -(weights[:, None] * (action - means[:, None]) ** 2 / (2.0 * variances[:, None])).sum(0)
    density = np.exp(log_product - log_product.max())
    density /= density.sum()
    mean_integrated = (density * action).sum()
    variance_integrated = (density * (action - mean_integrated) ** 2).sum()
    mean, variance = compose(weights, means[:, None], variances[:, None])
    np.testing.assert_allclose([mean[0], variance[0]], [mean_integrated, variance_integrated], rtol=1e-9)
