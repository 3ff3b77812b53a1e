"""The actors of ``sac_networks`` in NumPy, from exported parameters, and what they see of how things move.

They act without torch and without noise.
"""

from __future__ import annotations

import numpy as np

from service.base.types import FloatArray
from service.envs.observations import POSITIONS, ObservationLayout
from service.policies.forward import INPUT_CLIP, compose, prepared, relu_layers
from service.policies.parameters import Parameters, checked, fitting

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
"""Bounds of an actor's log-std before the tanh (Haarnoja et al. 2018)."""
MCP_LOG_STD_MIN = -5.0
"""Of a primitive's: with less, one that is sure decides alone and the others get no gradient."""

MOVED = ("effector", "object")
"""What an actor sees the movements of."""
STEP_SCALE_M = 0.02
"""Scale of movements in a step, as inputs: the hand's full speed is two to three times as much."""


def moved_columns(layout: ObservationLayout) -> list[int]:
    """Columns of positions whose movements are inputs: end effector and objects."""
    return [column for name in MOVED for column in range(layout[name].start, layout[name].stop)]


NUM_MOTION_INPUTS = POSITIONS.size + len(moved_columns(POSITIONS))
"""Of one object: positions 11, movements of end effector 3 and object 3; where more is observed, that comes besides."""


def motion_inputs(previous: FloatArray, positions: FloatArray, layout: ObservationLayout = POSITIONS) -> FloatArray:
    """(N, P + 3 + 3 K) inputs, all about 1: metres are too small for a new network.

    Positions at one moment do not say how fast the arm and the object move: the arm lags behind its commands, and what
    was pushed slides on. Two moments do, and a real robot has them; no velocity is measured.

    Args:
        previous: (N, P) positions one step ago; at an episode's start those of now.
        positions: (N, P), metres.
        layout: of positions.
    """
    seen = (positions - layout.normalisation.offset) / layout.normalisation.scale
    columns = moved_columns(layout)
    moved = (positions[:, columns] - previous[:, columns]) / np.float32(STEP_SCALE_M)
    inputs: FloatArray = np.concatenate((seen, moved), axis=1)
    return np.clip(inputs, -INPUT_CLIP, INPUT_CLIP, out=inputs)


class NumpyActor:
    """Actions ``tanh(mean)`` of a ``GaussianActor``.

    Args:
        parameters: as exported.

    Raises:
        PolicyError: a parameter is missing, of a wrong shape or not finite.
    """

    def __init__(self, parameters: Parameters) -> None:
        with fitting():
            self.network = prepared(np, checked(parameters))
            layers = self.network["layers"]
            self.num_inputs, self.num_actions = len(layers[0][0]), len(layers[-1][1]) // 2
            self(np.zeros((1, self.num_inputs), np.float32))

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """(N, A) actions at (N, I) inputs."""
        actions: FloatArray = np.tanh(relu_layers(np, self.network["layers"], inputs)[:, : self.num_actions])
        return actions


class NumpyMCPActor(NumpyActor):
    """Actions ``tanh(mean)`` of an ``MCPActor``."""

    def __init__(self, parameters: Parameters) -> None:
        with fitting():
            self.network = prepared(np, checked(parameters))
            num_primitives, hidden_size, num_outputs = self.network["output_weight"].shape
            self._heads, self.num_actions = (num_primitives, hidden_size), num_outputs // 2
            self._num_without_goal, self.num_inputs = (len(self.network[name][0][0]) for name in ("primitives", "gate"))
            self(np.zeros((1, self.num_inputs), np.float32))

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """(N, A) actions at (N, I) inputs."""
        network = self.network
        hidden = np.maximum(relu_layers(np, network["primitives"], inputs[:, : self._num_without_goal]), 0.0)
        heads = hidden.reshape(len(inputs), *self._heads)
        outputs = np.einsum("nkh,kho->nko", heads, network["output_weight"]) + network["output_bias"]
        means, log_stds = outputs[..., : self.num_actions], outputs[..., self.num_actions :]
        floor, opened = network["weight_floor"], relu_layers(np, network["gate"], inputs)
        weights = floor + (1.0 - floor) / (1.0 + np.exp(-opened))
        mean, _ = compose(weights, means, np.exp(2.0 * np.clip(log_stds, MCP_LOG_STD_MIN, LOG_STD_MAX)))
        actions: FloatArray = np.tanh(mean)
        return actions


def numpy_actor(parameters: Parameters) -> NumpyActor:
    """The actor of exported parameters, of whichever kind.

    Raises:
        PolicyError: they are of neither.
    """
    return NumpyMCPActor(parameters) if "output_weight" in parameters else NumpyActor(parameters)
