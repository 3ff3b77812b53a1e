"""Noise that is a function of a key and a count, so that a world's state says all of it."""

from __future__ import annotations

import numpy as np

from service.base.types import StateArray

KEYS = 1 << 52
"""Keys are whole numbers below this, which a float64 holds exactly."""
_GOLDEN, _FIRST, _SECOND = (np.uint64(each) for each in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


def normal(key: StateArray, count: StateArray, size: int) -> StateArray:
    """(N, size) independent standard normal numbers for (N,) keys and counts; equal ones give equal numbers."""
    draws = np.arange(2 * size, dtype=np.uint64)
    state = (_mixed(key.astype(np.uint64)) + count.astype(np.uint64))[:, None] * np.uint64(2 * size) + draws
    uniform = (_mixed(state) >> np.uint64(11)).astype(np.float64) * 2.0**-53
    radius = np.sqrt(-2.0 * np.log1p(-uniform[:, :size]))
    made: StateArray = radius * np.cos(2.0 * np.pi * uniform[:, size:])  # Box and Muller 1958
    return made


def _mixed(values: np.ndarray) -> np.ndarray:
    """SplitMix64 (Steele et al. 2014)."""
    mixed = values * _GOLDEN + _GOLDEN
    mixed = (mixed ^ (mixed >> np.uint64(30))) * _FIRST
    mixed = (mixed ^ (mixed >> np.uint64(27))) * _SECOND
    return mixed ^ (mixed >> np.uint64(31))
