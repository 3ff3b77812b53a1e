"""The composition of primitives: a product of Gaussians raised to gate weights."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

Array = TypeVar("Array", NDArray[np.float32], NDArray[np.float64], "Tensor")


def compose(weights: Array, means: Array, variances: Array) -> tuple[Array, Array]:
    """Multiply K diagonal Gaussians, each raised to its weight, and normalise (Peng et al. 2019, eq. 4).

    ``1 / variance = sum_k w_k / variance_k`` and ``mean = variance * sum_k w_k / variance_k * mean_k``, so the mean
    is a convex combination of the primitives' means, and scaling all weights scales the variance alone. The paper's
    sigma is a variance. Serves NumPy arrays and torch tensors alike.

    Args:
        weights: (..., K) gate weights, positive.
        means: (..., K, A).
        variances: (..., K, A), positive.

    Returns:
        Mean and variance of the composition, (..., A) each.
    """
    precisions = weights[..., None] / variances
    total = precisions.sum(-2)
    return (precisions * means).sum(-2) / total, 1.0 / total
