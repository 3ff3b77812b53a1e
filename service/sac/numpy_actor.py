"""The actors of ``networks`` in NumPy, from exported parameters: acting without torch and without noise."""

from __future__ import annotations

import numpy as np

from service.policies.composition import compose
from service.policies.parameters import ParameterReader, Parameters
from service.sac.limits import LOG_STD_MAX, MCP_LOG_STD_MIN
from service.types import FloatArray


class NumpyActor:
    """Actions ``tanh(mean)`` of a ``GaussianActor``.

    Args:
        parameters: as exported.

    Raises:
        PolicyError: a parameter is missing, left over, of a wrong shape or not finite.
    """

    def __init__(self, parameters: Parameters) -> None:
        reader = ParameterReader(parameters)
        self._layers = NumpyLayers(reader, "layers", None)
        self.num_inputs, self.num_actions = self._layers.num_inputs, self._layers.num_outputs // 2
        reader.finish()

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """(N, A) actions at (N, I) inputs."""
        actions: FloatArray = np.tanh(self._layers(inputs)[:, : self.num_actions])
        return actions


class NumpyMCPActor:
    """Actions ``tanh(mean)`` of an ``MCPActor``.

    Args:
        parameters: as exported.

    Raises:
        PolicyError: a parameter is missing, left over, of a wrong shape or not finite.
    """

    def __init__(self, parameters: Parameters) -> None:
        reader = ParameterReader(parameters)
        self._weight = reader.take("output_weight", (None, None, None))
        num_primitives, hidden_size, outputs = self._weight.shape
        self._bias = reader.take("output_bias", (num_primitives, outputs))
        self._primitives = NumpyLayers(reader, "primitives", num_primitives * hidden_size)
        self._gate = NumpyLayers(reader, "gate", num_primitives)
        self._weight_floor = reader.take_scalar("weight_floor", 0.0, 1.0)
        self.num_inputs, self.num_actions = self._gate.num_inputs, outputs // 2
        reader.finish()

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """(N, A) actions at (N, I) inputs."""
        hidden = np.maximum(self._primitives(inputs[:, : self._primitives.num_inputs]), 0.0)
        heads = hidden.reshape(len(inputs), *self._weight.shape[:2])
        outputs = np.einsum("nkh,kho->nko", heads, self._weight) + self._bias
        means, log_stds = outputs[..., : self.num_actions], outputs[..., self.num_actions :]
        weights = self._weight_floor + (1.0 - self._weight_floor) / (1.0 + np.exp(-self._gate(inputs)))
        mean, _ = compose(weights, means, np.exp(2.0 * np.clip(log_stds, MCP_LOG_STD_MIN, LOG_STD_MAX)))
        actions: FloatArray = np.tanh(mean)
        return actions


def numpy_actor(parameters: Parameters) -> NumpyActor | NumpyMCPActor:
    """The actor of exported parameters, of whichever kind.

    Raises:
        PolicyError: they are of neither.
    """
    return NumpyMCPActor(parameters) if "output_weight" in parameters else NumpyActor(parameters)


class NumpyLayers:
    """Affine maps with ReLU between them, as of ``networks.make_layers``; weights are kept transposed and contiguous.

    Args:
        reader: of the exported parameters.
        prefix: of their names.
        num_outputs: that are expected; None: any.

    Raises:
        PolicyError: a parameter is missing, of a wrong shape or not finite.
    """

    def __init__(self, reader: ParameterReader, prefix: str, num_outputs: int | None) -> None:
        self._layers: list[tuple[FloatArray, FloatArray]] = []
        inputs: int | None = None
        while (name := f"{prefix}.{2 * len(self._layers)}") + ".weight" in reader:
            last = f"{prefix}.{2 * len(self._layers) + 2}.weight" not in reader
            weight = reader.take(f"{name}.weight", (num_outputs if last else None, inputs))
            inputs = len(weight)
            self._layers.append((np.ascontiguousarray(weight.T), reader.take(f"{name}.bias", (inputs,))))
        if not self._layers:
            reader.take(f"{prefix}.0.weight", (None, None))  # says that it is missing
        self.num_inputs, self.num_outputs = self._layers[0][0].shape[0], self._layers[-1][0].shape[1]

    def __call__(self, rows: FloatArray) -> FloatArray:
        """(N, inputs) to (N, outputs)."""
        for weight, bias in self._layers[:-1]:
            rows = np.maximum(rows @ weight + bias, 0.0)
        weight, bias = self._layers[-1]
        result: FloatArray = rows @ weight + bias
        return result
