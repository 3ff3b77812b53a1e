"""Generalised advantage estimation for turns of unequal length. T steps (time first), N worlds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]
BoolArray = NDArray[np.bool_]


def advantages(
    rewards: FloatArray,
    values: FloatArray,
    final_values: FloatArray,
    active: BoolArray,
    terminated: BoolArray,
    *,
    gamma: float,
    gae_lambda: float,
) -> FloatArray:
    """GAE (Schulman et al. 2016, eq. 16), bootstrapped where a turn ran out of time (Pardo et al. 2018).

    ``A_t = d_t + gamma lambda A_{t+1}`` with ``d_t = r_t + gamma V_{t+1} - V_t``. Behind the last active step,
    ``A`` is 0 and ``V`` the final value; behind a terminated step both are 0.

    Args:
        rewards: (T, N).
        values: (T, N) at the states the actions were taken in; ignored where not active.
        final_values: (N,) of the state behind each world's last active step; ignored where that step terminated.
        active: (T, N) true up to each turn's last step, false after it.
        terminated: (T, N) the turn truly ended with this step.
        gamma: discount.
        gae_lambda: decay of the multi-step estimates.

    Returns:
        Advantages (T, N), zero where not active; ``advantages + values`` are the value targets.
    """
    result = np.zeros_like(rewards)
    next_value = final_values
    next_advantage = np.zeros_like(final_values)
    for step in reversed(range(len(rewards))):
        discount = np.where(terminated[step], 0.0, gamma).astype(rewards.dtype)
        error = rewards[step] + discount * next_value - values[step]
        advantage = error + discount * gae_lambda * next_advantage
        result[step] = np.where(active[step], advantage, 0.0)
        next_advantage = result[step]
        next_value = np.where(active[step], values[step], next_value)
    return result


def explained_variance(returns: FloatArray, values: FloatArray) -> float:
    """Share of the variance of ``returns`` that ``values`` predict: 1 at best, 0 for a constant (any shape)."""
    variance = float(np.var(returns))
    return 1.0 - float(np.var(returns - values)) / variance if variance > 0.0 else 0.0
