"""Networks of Tandem, to act with: this file and NumPy are all that is needed.

``load("policy.npz")`` gives a function of float32 arrays. N is the number of rows, any from 1 on::

    policy = load("policy.npz")
    action = policy(observation)["action"]  # (N, O) to (N, A)

Which numbers an observation has, in which units, is in ``policy.json`` beside it. A NaN in what a network looks at
gives an action of NaN: check before you send it to a robot.
"""

# The export writes a copy of this file, and has the same functions carried out by torch, so nothing is imported from
# Tandem, and `xp` is numpy or torch.

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

Array = Any
"""An array of ``xp``."""
Parameters = Mapping[str, Array]
Columns = Mapping[str, slice]
"""Places of what a network looks for in its observation."""
Outputs = dict[str, Array]

_INPUT_CLIP = 5.0
_MEAN_BOUND = 2.0
_WEIGHT_RATIO = 100.0


def load(path: Path | str) -> Callable[..., Outputs]:
    """Load a network.

    Args:
        path: of a ``.npz`` file of this folder.

    Returns:
        A function of the network's inputs, (N, size) arrays in the order of ``policy.json``, to its outputs by name.
    """
    with np.load(path, allow_pickle=False) as file:
        stored = {name: file[name] for name in file.files}
    function = FUNCTIONS[str(stored.pop("function"))]
    sizes = [int(size) for size in stored.pop("input_sizes")]
    columns = {
        name.removeprefix(COLUMNS): slice(*map(int, stored.pop(name))) for name in [*stored] if name.startswith(COLUMNS)
    }

    def run(*inputs: Any) -> Outputs:
        rows = [np.asarray(values, dtype=np.float32) for values in inputs]
        found = [values.shape[1:] for values in rows]
        if found != [(size,) for size in sizes] or len({len(values) for values in rows}) != 1:
            wanted = ", ".join(f"(N, {size})" for size in sizes)
            raise ValueError(f"expected arrays of {wanted}, got {', '.join(str(each.shape) for each in rows)}")
        return function(np, stored, columns, *rows)

    return run


def bob(xp: Any, parameters: Parameters, columns: Columns, observation: Array) -> Outputs:
    """Compose the primitives by the gate's weights; the gate alone sees the goal."""
    way = observation[:, columns["goal"]] - observation[:, columns["object"]]
    hidden = _normalised(xp, parameters, "gate.input", xp.concatenate([observation, way], 1))
    opened = _linear(parameters, "gate.output", _elu_layers(xp, parameters, "gate.hidden", hidden))
    floor = parameters["gate.weight_floor"]
    weights = floor + (1.0 - floor) * _sigmoid(xp, opened)
    means, variances = _primitives(xp, parameters, observation[:, columns["positions"]])
    action = xp.clip(_compose(weights, means, variances), -1.0, 1.0)
    return {"action": action, "weights": weights, "means": means, "variances": variances}


def monolithic(xp: Any, parameters: Parameters, columns: Columns, observation: Array) -> Outputs:
    """Act by one network without primitives."""
    hidden = _elu_layers(xp, parameters, "hidden", _normalised(xp, parameters, "input", observation))
    output = _linear(parameters, "output", hidden)
    return {"action": xp.clip(_bounded_mean(xp, output[:, : output.shape[1] // 2]), -1.0, 1.0)}


def primitive(xp: Any, parameters: Parameters, columns: Columns, positions: Array) -> Outputs:
    """Act by one primitive, which does not see the goal."""
    means, variances = _primitives(xp, parameters, positions)
    mean = means[:, 0]
    return {"action": xp.clip(mean, -1.0, 1.0), "mean": mean, "variance": variances[:, 0]}


def orchestrator(
    xp: Any, parameters: Parameters, columns: Columns, previous_positions: Array, observation: Array
) -> Outputs:
    """Compose the primitives by weights that were learned for a task, from positions now and one step ago."""
    positions, goal = observation[:, columns["positions"]], observation[:, columns["goal"]]
    features = [positions]
    features += [positions[:, columns[name]] - previous_positions[:, columns[name]] for name in ("effector", "object")]
    features += [goal, goal - positions[:, columns["object"]]]
    hidden = _normalised(xp, parameters, "actor.input", xp.concatenate(features, 1))
    num_layers = sum(name.startswith("actor.layers.") for name in parameters) // 2
    for layer in range(num_layers - 1):
        hidden = xp.clip(_linear(parameters, f"actor.layers.{layer}", hidden), 0.0, None)
    output = _linear(parameters, f"actor.layers.{num_layers - 1}", hidden)
    chosen = xp.tanh(output[:, : output.shape[1] // 2])
    means, variances = _primitives(xp, parameters, positions)
    num_primitives = means.shape[1]
    weights = _WEIGHT_RATIO ** (0.5 * (chosen[:, :num_primitives] - 1.0))
    action = _compose(weights, means, variances)
    if chosen.shape[1] > num_primitives:  # a small action of its own is added
        action = action + parameters["actor.residual"] * chosen[:, num_primitives:]
    return {"action": xp.clip(action, -1.0, 1.0), "weights": weights, "means": means, "variances": variances}


FUNCTIONS: Mapping[str, Callable[..., Outputs]] = {
    each.__name__: each for each in (bob, monolithic, primitive, orchestrator)
}
COLUMNS = "columns."
"""Begins the names of columns in a file of parameters."""


def _primitives(xp: Any, parameters: Parameters, positions: Array) -> tuple[Array, Array]:
    """Means and variances, (N, K, A) each."""
    trunk = _normalised(xp, parameters, "primitives.input", positions)
    trunk = _elu_layers(xp, parameters, "primitives.trunk", trunk)
    hidden = _elu(xp, _linear(parameters, "primitives.hidden", trunk))
    weight, bias = parameters["primitives.output_weight"], parameters["primitives.output_bias"]
    heads = hidden.reshape(-1, weight.shape[0], 1, weight.shape[1])
    output = (heads @ weight)[:, :, 0] + bias
    num_actions = bias.shape[1] // 2
    low, high = parameters["primitives.squash.log_std_min"], parameters["primitives.squash.log_std_max"]
    log_stds = low + (high - low) * _sigmoid(xp, output[:, :, num_actions:])
    return _bounded_mean(xp, output[:, :, :num_actions]), xp.exp(2.0 * log_stds)


def _compose(weights: Array, means: Array, variances: Array) -> Array:
    """Mean of the product of the primitives' Gaussians raised to their weights (Peng et al. 2019, eq. 4)."""
    precisions = weights[:, :, None] / variances
    return (precisions * means).sum(1) / precisions.sum(1)


def _normalised(xp: Any, parameters: Parameters, prefix: str, rows: Array) -> Array:
    scaled = (rows - parameters[f"{prefix}.offset"]) / parameters[f"{prefix}.scale"]
    return xp.clip(scaled, -_INPUT_CLIP, _INPUT_CLIP)


def _elu_layers(xp: Any, parameters: Parameters, prefix: str, rows: Array) -> Array:
    layer = 0
    while f"{prefix}.{layer}.weight" in parameters:
        rows = _elu(xp, _linear(parameters, f"{prefix}.{layer}", rows))
        layer += 1
    return rows


def _linear(parameters: Parameters, name: str, rows: Array) -> Array:
    return rows @ parameters[f"{name}.weight"].T + parameters[f"{name}.bias"]


def _elu(xp: Any, values: Array) -> Array:
    return xp.maximum(values, xp.exp(xp.clip(values, None, 0.0)) - 1.0)


def _bounded_mean(xp: Any, values: Array) -> Array:
    return _MEAN_BOUND * xp.tanh(values / _MEAN_BOUND)


def _sigmoid(xp: Any, values: Array) -> Array:
    return 0.5 + 0.5 * xp.tanh(0.5 * values)
