"""The players in NumPy, from exported parameters: acting without torch.

This is what actors, downstream users and a robot run. Everything is float32. A policy has no state but its parameters,
so threads may share one. Shapes: N rows, P positions, O observation size, K primitives, A action components.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from service.base.types import FloatArray
from service.envs.observations import ACTION, POSITIONS
from service.policies import forward
from service.policies.parameters import Parameters, PolicyError, checked, fitting

_SMALLEST, _GREATEST = 1e-30, 1e30
"""Of a row's greatest weight: beyond these the product of Gaussians may overflow float32."""
_HALF_LOG_TWO_PI = np.float32(0.5 * math.log(2.0 * math.pi))


class NumpyPolicy(ABC):
    """A diagonal Gaussian over actions whose mean and std are functions of the observation."""

    network: Mapping[str, Any]
    """Parameters as ``forward`` takes them."""
    columns: Mapping[str, slice]
    """Places of what it looks for in an observation."""
    action_size = ACTION.size
    """A."""

    @abstractmethod
    def distribution(self, observation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and std, (..., A) each, of the action at (..., O) observations.

        Raises:
            PolicyError: the observation's last axis is not O.
        """

    def act(self, observation: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Sample actions (..., A), not clipped, and compute their log-probabilities (...,)."""
        mean, std = self.distribution(observation)
        noise = rng.standard_normal(mean.shape, dtype=np.float32)
        log_prob = -(0.5 * noise * noise + np.log(std) + _HALF_LOG_TWO_PI).sum(-1)
        return mean + std * noise, log_prob

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        """Compute the mean action (..., A)."""
        return self.distribution(observation)[0]


class NumpyGaussianPolicy(NumpyPolicy):
    """Alice, or a monolithic Bob: one network gives mean and std."""

    def __init__(self, parameters: Parameters) -> None:
        """Take the parameters of a ``networks.GaussianPolicy``.

        Raises:
            PolicyError: a parameter is missing, of a wrong shape or not finite.
        """
        with fitting():
            self.network, self.columns = forward.prepared(np, checked(parameters)), {}
            self._num_inputs = len(parameters["input.offset"])
            self.distribution(np.zeros(self._num_inputs, np.float32))

    def distribution(self, observation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and std, (..., A) each; see ``NumpyPolicy.distribution``."""
        mean, log_std = forward.gaussian(np, self.network, _rows(observation, self._num_inputs, "observation"))
        shape = (*np.shape(observation)[:-1], self.action_size)
        return mean.reshape(shape), np.exp(log_std).reshape(shape)


class NumpyMCPPolicy(NumpyPolicy):
    """Bob: primitives that see positions only, a gate that sees the goal as well, and their composition."""

    def __init__(self, parameters: Parameters) -> None:
        """Take the parameters of a ``networks.MCPPolicy``.

        Raises:
            PolicyError: a parameter is missing, of a wrong shape or not finite.
        """
        with fitting():
            self.network = forward.prepared(np, checked(parameters))
            self.num_positions = len(parameters["primitives.input.offset"])
            """P; the observation O is these and the goal."""
            self.num_primitives = len(parameters["primitives.output_weight"])
            self.num_goal = (len(parameters["gate.input.offset"]) - self.num_positions) // 2
            """3 for each object; the gate also sees the ways to the goals."""
            first, num_seen = POSITIONS["object"].start, self.num_positions + self.num_goal
            self.columns = {
                "positions": slice(0, self.num_positions),
                "object": slice(first, first + self.num_goal),
                "goal": slice(self.num_positions, num_seen),
            }
            self.distribution(np.zeros(num_seen, np.float32))

    def primitives(self, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Means and variances, (..., K, A) each, of the primitives at (..., P) positions.

        Raises:
            PolicyError: the last axis is not P.
        """
        means, variances = forward.primitives(np, self.network, _rows(positions, self.num_positions, "positions"))
        shape = (*np.shape(positions)[:-1], self.num_primitives, self.action_size)
        return means.reshape(shape), variances.reshape(shape)

    def gate(self, observation: FloatArray) -> FloatArray:
        """Weights (..., K) at (..., O) observations, each in [floor, 1].

        Raises:
            PolicyError: the last axis is not O.
        """
        rows = _rows(observation, self.num_positions + self.num_goal, "observation")
        weights: FloatArray = forward.gate(np, self.network, self.columns, rows)
        return weights.reshape((*np.shape(observation)[:-1], self.num_primitives))

    def compose(self, positions: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and std, (..., A) each, of the primitives at (..., P) positions under given (..., K) weights.

        Raises:
            PolicyError: the last axis is not P, or not K; a weight that is not from 0 to 1e30, or all of a row 0.
        """
        weights = np.asarray(weights, dtype=np.float32)
        if weights.shape[-1:] != (self.num_primitives,):
            raise PolicyError(f"weights: expected shape (..., {self.num_primitives}), got {weights.shape}")
        greatest = weights.max(axis=-1, initial=0.0)
        fits = (greatest >= _SMALLEST).all() and (greatest <= _GREATEST).all()  # NaN fits in neither
        if not (fits and weights.min(initial=0.0) >= 0.0):
            raise PolicyError("weights: give numbers from 0 to 1e30, and in each row one above 1e-30")
        return self.composed(positions, weights)

    def distribution(self, observation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and std, (..., A) each, of the composition at (..., O) observations.

        Raises:
            PolicyError: the observation's last axis is not O.
        """
        return self.composed(np.asarray(observation)[..., : self.num_positions], self.gate(observation))

    def composed(self, positions: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As ``compose``, of (..., K) float32 weights that a network gave: they are not checked, and NaN gives NaN."""
        mean, variance = forward.compose(weights, *self.primitives(positions))
        return mean, np.sqrt(variance)


def numpy_bob(parameters: Parameters) -> NumpyPolicy:
    """Make the Bob of a run: composed, or monolithic where the configuration said so.

    Raises:
        PolicyError: parameters of neither.
    """
    composed = any(name.startswith("primitives.") for name in parameters)
    return NumpyMCPPolicy(parameters) if composed else NumpyGaussianPolicy(parameters)


def _rows(values: FloatArray, size: int, name: str) -> FloatArray:
    """The (..., size) values as (N, size) float32 rows."""
    array = np.asarray(values, dtype=np.float32)
    if array.shape[-1:] != (size,):
        raise PolicyError(f"{name}: expected shape (..., {size}), got {array.shape}")
    return array.reshape(-1, size)
