"""95 % intervals of success: of one share of episodes, and of the mean over the seeds of a method."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

_STUDENT = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131,
    2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
)  # fmt: skip
"""97.5th percentiles of Student's t for 1 to 30 degrees of freedom; 1.96 is near enough for more."""


class Rate(NamedTuple):
    """A share of episodes, and both ends of its 95 % interval."""

    mean: float
    low: float
    high: float
    num_seeds: int

    def __str__(self) -> str:
        """Such as ``97.0 % [96, 98] (3)``; a star marks the interval of a single seed."""
        star = "*" * (self.num_seeds == 1)
        return f"{100 * self.mean:.1f} % [{100 * self.low:.0f}, {100 * self.high:.0f}]{star} ({self.num_seeds})"


def rate_of(results: Sequence[Mapping[str, Any]], key: str = "success_last") -> Rate:
    """The mean over one or more seeds.

    The interval of several is for the mean over seeds (Student's t), and no narrower than Wilson's over all their
    episodes: seeds that are equal by chance would have none. That of one is Wilson's: it says how far the share may be
    off because episodes were few, not how far another seed would differ.

    Args:
        results: of one method on one task, a seed each, as ``result.json`` has them.
        key: of ``evaluation``.
    """
    evaluations = [result["evaluation"] for result in results]
    rates, num = [float(each[key]) for each in evaluations], sum(each["num_episodes"] for each in evaluations)
    mean = float(np.mean(rates))
    low, high = wilson_interval(round(mean * num), num)
    if len(rates) > 1:
        least, greatest = seed_interval(rates)
        low, high = min(low, least), max(high, greatest)
    return Rate(mean, low, high, len(rates))


def seed_interval(rates: Sequence[float]) -> tuple[float, float]:
    """Both ends of the 95 % interval for the mean of two or more seeds' rates, by Student's t, inside [0, 1]."""
    degrees = len(rates) - 1
    quantile = _STUDENT[degrees - 1] if degrees <= len(_STUDENT) else 1.96
    half = quantile * float(np.std(rates, ddof=1)) / math.sqrt(len(rates))
    return max(0.0, float(np.mean(rates)) - half), min(1.0, float(np.mean(rates)) + half)


def wilson_interval(successes: int, num: int) -> tuple[float, float]:
    """95 % Wilson score interval of a proportion (Wilson 1927)."""
    z, share = 1.96, successes / num
    centre = (share + z * z / (2 * num)) / (1 + z * z / num)
    half = z * np.sqrt(share * (1 - share) / num + z * z / (4 * num * num)) / (1 + z * z / num)
    return float(max(centre - half, 0.0)), float(min(centre + half, 1.0))
