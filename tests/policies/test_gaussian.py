"""Densities of diagonal Gaussians, against closed forms and torch.distributions."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch.distributions import Independent, Normal, kl_divergence

from service.policies.gaussian import entropy, kl, log_prob


def _pair() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    mean0, mean1 = torch.randn(2, 7, 5, 4, generator=generator, dtype=torch.float64)
    std0, std1 = torch.rand(2, 7, 5, 4, generator=generator, dtype=torch.float64) + 0.1
    return mean0, std0, mean1, std1


def test_log_prob_by_hand() -> None:
    # one std away in the first component, at the mean in the second
    value = log_prob(torch.tensor([1.5, 0.0]), torch.tensor([1.0, 0.0]), torch.tensor([0.5, 2.0]))
    expected = -0.5 - math.log(0.5) - math.log(2.0) - math.log(2.0 * math.pi)
    np.testing.assert_allclose(value.item(), expected, rtol=1e-6)


def test_kl_by_hand() -> None:
    # KL(N(1, 2^2) || N(0, 1)) = (4 + 1 - 1 - ln 4) / 2
    value = kl(torch.tensor([1.0]), torch.tensor([2.0]), torch.tensor([0.0]), torch.tensor([1.0]))
    np.testing.assert_allclose(value.item(), (4.0 - math.log(4.0)) / 2.0, rtol=1e-6)


def test_all_agree_with_torch_distributions() -> None:
    mean0, std0, mean1, std1 = _pair()
    first, second = Independent(Normal(mean0, std0), 1), Independent(Normal(mean1, std1), 1)
    torch.testing.assert_close(log_prob(mean1, mean0, std0), first.log_prob(mean1))
    torch.testing.assert_close(entropy(std0), first.entropy())
    torch.testing.assert_close(kl(mean0, std0, mean1, std1), kl_divergence(first, second))
    assert entropy(std0).shape == (7, 5)


def test_kl_of_a_distribution_from_itself_is_zero() -> None:
    mean, std, _, _ = _pair()
    torch.testing.assert_close(kl(mean, std, mean, std), torch.zeros(7, 5, dtype=torch.float64), atol=1e-14, rtol=0.0)
