"""Estimates from samples that say how sure they are: percentiles, and slopes of series whose noise has a memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

NUM_BLOCKS = 20
"""A series is cut into so many, each far longer than its noise remembers."""
_T_95 = 2.101
"""97.5 % of Student's t with NUM_BLOCKS - 2 degrees of freedom."""


@dataclass(frozen=True, slots=True)
class Slope:
    """How fast something grows, with its 95 % confidence interval, per unit of x."""

    value: float
    low: float
    high: float


def slope(x: Sequence[float], y: Sequence[float]) -> Slope:
    """Least squares through the means of ``NUM_BLOCKS`` blocks of consecutive samples.

    Neighbouring samples of memory are nearly the same number, and taking each for a witness of its own would make
    the interval far too small; means of blocks are nearly independent.

    Raises:
        ValueError: fewer samples than two a block, or all at one x.
    """
    if len(x) < 2 * NUM_BLOCKS:
        raise ValueError(f"{len(x)} samples are too few for a slope, {2 * NUM_BLOCKS} are needed")
    xs, ys = (np.array([part.mean() for part in np.array_split(np.asarray(v, float), NUM_BLOCKS)]) for v in (x, y))
    dx = xs - xs.mean()
    spread = float(dx @ dx)
    if spread == 0.0:
        raise ValueError("a slope needs more than one x")
    value = float(dx @ ys) / spread
    rest = ys - ys.mean() - value * dx
    error = _T_95 * math.sqrt(float(rest @ rest) / (NUM_BLOCKS - 2) / spread)
    return Slope(value, value - error, value + error)


def percentile(values: Sequence[float], share: float) -> float:
    """The smallest value that at least ``share`` of all do not exceed; nothing is interpolated.

    Raises:
        ValueError: there are no values.
    """
    if not values:
        raise ValueError("no values")
    return sorted(values)[max(0, math.ceil(share * len(values)) - 1)]
