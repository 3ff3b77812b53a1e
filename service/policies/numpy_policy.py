"""The policies of ``networks`` in NumPy, from exported parameters: acting without torch.

This is what actors, downstream users and a robot run. Everything is float32. A policy has no state but its parameters,
so threads may share one. Shapes: N rows, P positions, O observation size, K primitives, A action components.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from service.envs.observations import PAPER, POSITIONS
from service.policies.composition import compose
from service.policies.parameters import INPUT_CLIP, MEAN_BOUND, ParameterReader, Parameters, PolicyError
from service.types import FloatArray

_NUM_GOAL = PAPER.bob.size - PAPER.positions.size
_HALF_LOG_TWO_PI = np.float32(0.5 * math.log(2.0 * math.pi))


class NumpyPolicy(ABC):
    """A diagonal Gaussian over actions whose mean and std are functions of the observation."""

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
            PolicyError: a parameter is missing, left over, of a wrong shape or not finite.
        """
        reader = ParameterReader(parameters)
        self._input = _Input(reader, "input", None)
        self._hidden = _HiddenLayers(reader, "hidden", self._input.size)
        self._output = _Layer(reader, "output", None, self._hidden.output_size)
        self._squash = _GaussianSquash(reader, "squash", self._output.output_size)
        self.action_size = self._squash.action_size
        reader.finish()

    def distribution(self, observation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and std, (..., A) each; see ``NumpyPolicy.distribution``."""
        rows = _rows(observation, self._input.size, "observation")
        mean, log_std = self._squash(self._output(self._hidden(self._input(rows))))
        shape = (*np.shape(observation)[:-1], self.action_size)
        return mean.reshape(shape), np.exp(log_std).reshape(shape)


class NumpyMCPPolicy(NumpyPolicy):
    """Bob: primitives that see positions only, a gate that sees the goal as well, and their composition."""

    def __init__(self, parameters: Parameters) -> None:
        """Take the parameters of a ``networks.MCPPolicy``.

        Raises:
            PolicyError: a parameter is missing, left over, of a wrong shape or not finite.
        """
        reader = ParameterReader(parameters)
        self._primitives = _Primitives(reader)
        self.num_positions = self._primitives.num_positions
        """P; the observation O is these and the goal."""
        self._gate = _Gate(reader, self._primitives.num_primitives, self.num_positions)
        self.num_primitives = self._primitives.num_primitives
        self.action_size = self._primitives.action_size
        reader.finish()

    def primitives(self, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Means and variances, (..., K, A) each, of the primitives at (..., P) positions.

        Raises:
            PolicyError: the last axis is not P.
        """
        means, variances = self._primitives(_rows(positions, self.num_positions, "positions"))
        shape = (*np.shape(positions)[:-1], self.num_primitives, self.action_size)
        return means.reshape(shape), variances.reshape(shape)

    def gate(self, observation: FloatArray) -> FloatArray:
        """Weights (..., K) at (..., O) observations, each in [floor, 1].

        Raises:
            PolicyError: the last axis is not O.
        """
        weights = self._gate(_rows(observation, self.num_positions + _NUM_GOAL, "observation"))
        return weights.reshape((*np.shape(observation)[:-1], self.num_primitives))

    def compose(self, positions: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and std, (..., A) each, of the primitives at (..., P) positions under given (..., K) weights.

        Raises:
            PolicyError: the last axis is not P, or not K.
        """
        weights = np.asarray(weights, dtype=np.float32)
        if weights.shape[-1:] != (self.num_primitives,):
            raise PolicyError(f"weights: expected shape (..., {self.num_primitives}), got {weights.shape}")
        mean, variance = compose(weights, *self.primitives(positions))
        return mean, np.sqrt(variance)

    def distribution(self, observation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and std, (..., A) each, of the composition at (..., O) observations.

        Raises:
            PolicyError: the observation's last axis is not O.
        """
        weights = self.gate(observation)
        return self.compose(np.asarray(observation)[..., : self.num_positions], weights)


def numpy_bob(parameters: Parameters) -> NumpyPolicy:
    """Make the Bob of a run: composed, or monolithic where the configuration said so.

    Raises:
        PolicyError: parameters of neither.
    """
    composed = any(name.startswith("primitives.") for name in parameters)
    return NumpyMCPPolicy(parameters) if composed else NumpyGaussianPolicy(parameters)


class _Primitives:
    """Means and variances (N, K, A) at (N, P) positions; the K heads share one matrix product per layer."""

    def __init__(self, reader: ParameterReader) -> None:
        self._input = _Input(reader, "primitives.input", None)
        self.num_positions = self._input.size
        if self.num_positions < POSITIONS.size:
            raise PolicyError(
                f"policy parameters 'primitives.input': {self.num_positions} positions; every layout has at least "
                f"{POSITIONS.size}"
            )
        self._trunk = _HiddenLayers(reader, "primitives.trunk", self.num_positions)
        self._weight = reader.take("primitives.output_weight", (None, None, None))
        self.num_primitives, self._head_size, outputs = self._weight.shape
        self._bias = reader.take("primitives.output_bias", (self.num_primitives, outputs))[:, None]
        head_sizes = (self.num_primitives * self._head_size, self._trunk.output_size)
        self._head = _Layer(reader, "primitives.hidden", *head_sizes)
        self._squash = _GaussianSquash(reader, "primitives.squash", outputs)
        self.action_size = self._squash.action_size

    def __call__(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        hidden = _elu(self._head(self._trunk(self._input(rows))))
        heads = hidden.reshape(-1, self.num_primitives, self._head_size)
        output = np.matmul(heads.transpose(1, 0, 2), self._weight)  # (K, N, 2A)
        output += self._bias
        means, log_stds = self._squash(output)
        log_stds *= 2.0
        return means.transpose(1, 0, 2), np.exp(log_stds, out=log_stds).transpose(1, 0, 2)


class _Gate:
    """Weights (N, K) at (N, O) observations."""

    def __init__(self, reader: ParameterReader, num_primitives: int, num_positions: int) -> None:
        self._goal = slice(num_positions, num_positions + _NUM_GOAL)
        self._input = _Input(reader, "gate.input", num_positions + 2 * _NUM_GOAL)
        self._hidden = _HiddenLayers(reader, "gate.hidden", self._input.size)
        self._output = _Layer(reader, "gate.output", num_primitives, self._hidden.output_size)
        self._floor = reader.take_scalar("gate.weight_floor", 0.0, 1.0)

    def __call__(self, rows: FloatArray) -> FloatArray:
        goal_from_object = rows[:, self._goal] - rows[:, POSITIONS["object"]]
        features = np.concatenate((rows, goal_from_object), axis=1)
        output = self._output(self._hidden(self._input(features)))
        return _squash(output, self._floor, np.float32(1.0) - self._floor)


class _Input:
    """Fixed normalisation, clipped."""

    def __init__(self, reader: ParameterReader, prefix: str, size: int | None) -> None:
        self._offset = reader.take(f"{prefix}.offset", (size,))
        self.size = self._offset.shape[0]
        self._scale = reader.take(f"{prefix}.scale", (self.size,))
        if not (self._scale > 0.0).all():
            raise PolicyError(f"policy parameter '{prefix}.scale' = {self._scale}: expected positive values")

    def __call__(self, rows: FloatArray) -> FloatArray:
        normalised: FloatArray = rows - self._offset
        normalised /= self._scale
        np.maximum(normalised, -INPUT_CLIP, out=normalised)
        return np.minimum(normalised, INPUT_CLIP, out=normalised)


class _Layer:
    """An affine map; the stored (outputs, inputs) weight is kept transposed and contiguous."""

    def __init__(self, reader: ParameterReader, prefix: str, outputs: int | None, inputs: int) -> None:
        weight = reader.take(f"{prefix}.weight", (outputs, inputs))
        self.output_size = weight.shape[0]
        self._weight = np.ascontiguousarray(weight.T)
        self._bias = reader.take(f"{prefix}.bias", (self.output_size,))

    def __call__(self, rows: FloatArray) -> FloatArray:
        output: FloatArray = rows @ self._weight
        output += self._bias
        return output


class _HiddenLayers:
    """Affine maps, each followed by ELU."""

    def __init__(self, reader: ParameterReader, prefix: str, input_size: int) -> None:
        self._layers = [_Layer(reader, f"{prefix}.0", None, input_size)]
        while f"{prefix}.{len(self._layers)}.weight" in reader:
            self._layers.append(_Layer(reader, f"{prefix}.{len(self._layers)}", None, self._layers[-1].output_size))
        self.output_size = self._layers[-1].output_size

    def __call__(self, rows: FloatArray) -> FloatArray:
        for layer in self._layers:
            rows = _elu(layer(rows))
        return rows


class _GaussianSquash:
    """Bounded mean and log-std, (..., A) each, of raw outputs (..., 2A)."""

    def __init__(self, reader: ParameterReader, prefix: str, outputs: int) -> None:
        self.action_size, odd = divmod(outputs, 2)
        if odd:
            raise PolicyError(f"policy parameters of {prefix!r}: expected an even number of outputs, got {outputs}")
        low = reader.take_scalar(f"{prefix}.log_std_min", -math.inf, math.inf)
        high = reader.take_scalar(f"{prefix}.log_std_max", float(low), math.inf)
        self._low = np.repeat(np.asarray([-MEAN_BOUND, low], dtype=np.float32), self.action_size)
        self._span = np.repeat(np.asarray([2.0 * MEAN_BOUND, high - low], dtype=np.float32), self.action_size)

    def __call__(self, output: FloatArray) -> tuple[FloatArray, FloatArray]:
        squashed = _squash(output, self._low, self._span)
        return squashed[..., : self.action_size], squashed[..., self.action_size :]


def _rows(values: FloatArray, size: int, name: str) -> FloatArray:
    """The (..., size) values as (N, size) float32 rows."""
    array = np.asarray(values, dtype=np.float32)
    if array.shape[-1:] != (size,):
        raise PolicyError(f"{name}: expected shape (..., {size}), got {array.shape}")
    return array.reshape(-1, size)


def _elu(values: FloatArray) -> FloatArray:
    """ELU in place. For x < 0, exp(x) - 1 >= x, and for x >= 0 the first term is 0: a maximum picks the branch."""
    negative = np.minimum(values, 0.0)
    np.exp(negative, out=negative)
    negative -= 1.0
    return np.maximum(values, negative, out=values)


def _squash(values: FloatArray, low: FloatArray | np.float32, span: FloatArray | np.float32) -> FloatArray:
    """``low + span * sigmoid(x)`` in place, by way of tanh, which does not overflow.

    The mean's ``2 tanh(x / 2)`` is ``-2 + 4 sigmoid(x)``.
    """
    values *= 0.5
    np.tanh(values, out=values)
    values += 1.0
    values *= 0.5 * span
    values += low
    return values
