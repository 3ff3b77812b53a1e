"""The product of Gaussians, against hand computation and numeric integration."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from service.policies.forward import compose

FloatArray = NDArray[np.float64]


def _random_gaussians(num_rows: int = 50) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(3)
    weights = rng.uniform(0.01, 1.0, (num_rows, 4))
    means = rng.uniform(-2.0, 2.0, (num_rows, 4, 3))
    variances = np.exp(rng.uniform(-4.0, 1.0, (num_rows, 4, 3)))
    return weights, means, variances


def test_two_primitives_by_hand() -> None:
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


def test_sigma_is_a_variance_not_a_std() -> None:
    # were sigma a std, its square would weigh: precisions 1 / 0.0625 and 1 instead of 4 and 1
    mean, variance = compose(np.ones(2), np.array([[1.0], [0.0]]), np.array([[0.25], [1.0]]))
    np.testing.assert_allclose([mean[0], variance[0]], [0.8, 0.2], rtol=1e-14)


def test_agrees_with_the_integrated_product() -> None:
    weights, means, variances = np.array([0.3, 0.9, 0.05]), np.array([-0.7, 0.4, 1.9]), np.array([0.3, 0.5, 0.02])
    action = np.linspace(-12.0, 12.0, 200_001)
    log_product = -(weights[:, None] * (action - means[:, None]) ** 2 / (2.0 * variances[:, None])).sum(0)
    density = np.exp(log_product - log_product.max())
    density /= density.sum()
    mean_integrated = (density * action).sum()
    variance_integrated = (density * (action - mean_integrated) ** 2).sum()
    mean, variance = compose(weights, means[:, None], variances[:, None])
    np.testing.assert_allclose([mean[0], variance[0]], [mean_integrated, variance_integrated], rtol=1e-9)


def test_equal_precisions_average_the_means() -> None:
    _, means, _ = _random_gaussians()
    mean, variance = compose(np.full((50, 4), 0.5), means, np.full_like(means, 0.8))
    np.testing.assert_allclose(mean, means.mean(1), rtol=1e-12)
    np.testing.assert_allclose(variance, 0.8 / (4 * 0.5), rtol=1e-12)


def test_one_primitive_of_weight_one_is_itself() -> None:
    _, means, variances = _random_gaussians()
    mean, variance = compose(np.ones((50, 1)), means[:, :1], variances[:, :1])
    np.testing.assert_allclose(mean, means[:, 0], rtol=1e-12)
    np.testing.assert_allclose(variance, variances[:, 0], rtol=1e-12)


@pytest.mark.parametrize("factor", [0.01, 0.5, 7.0])
def test_scaling_the_weights_scales_only_the_variance(factor: float) -> None:
    weights, means, variances = _random_gaussians()
    mean, variance = compose(weights, means, variances)
    scaled_mean, scaled_variance = compose(factor * weights, means, variances)
    np.testing.assert_allclose(scaled_mean, mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(scaled_variance, variance / factor, rtol=1e-12)


def test_the_mean_stays_in_the_convex_hull() -> None:
    weights, means, variances = _random_gaussians(1000)
    mean, _ = compose(weights, means, variances)
    assert (mean >= means.min(1) - 1e-12).all()
    assert (mean <= means.max(1) + 1e-12).all()


def test_float32_stays_float32() -> None:
    mean, variance = compose(*(array.astype(np.float32) for array in _random_gaussians()))
    assert mean.dtype == variance.dtype == np.float32
