"""Networks of Tandem, to act with: this file and NumPy are all that is needed.

``load("policy.npz")`` gives a function of float32 arrays. N is the number of rows, any from 1 on::

    policy = load("policy.npz")
    action = policy(observation)["action"]  # (N, O) to (N, A)

Which numbers an observation has, in which units, is in ``policy.json`` beside it. A NaN in what a network looks at
gives an action of NaN: check before you send it to a robot.
"""

# Tandem acts by these networks, an export writes a copy of this file, and torch carries the same networks out for the
# other formats. So nothing is imported from Tandem, and `xp` is NumPy or has its functions. `out` saves NumPy a copy;
# what a function returns counts.

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Array = Any
"""An array of ``xp``."""
Parameters = Mapping[str, Any]
"""Arrays by name; once ``prepared``, also lists of layers."""
Layers = Sequence[tuple[Array, Array]]
Columns = Mapping[str, slice]
"""Places of what a network looks for in its observation."""
Outputs = dict[str, Array]

INPUT_CLIP = 5.0
"""Normalised inputs are clipped to +- this."""
MEAN_BOUND = 2.0
"""Means are ``MEAN_BOUND * tanh(x / MEAN_BOUND)``: slope 1 at 0, and a little room past the action's [-1, 1]."""
WEIGHT_RATIO = 100.0
"""Greatest weight over least that an orchestrator sets. Bob's own gate has the same range, [0.01, 1]."""
COLUMNS = "columns."
"""Begins the names of columns in a file of parameters."""


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
    parameters = prepared(np, stored)

    def run(*inputs: Any) -> Outputs:
        rows = [np.asarray(values, dtype=np.float32) for values in inputs]
        found = [values.shape[1:] for values in rows]
        if found != [(size,) for size in sizes] or len({len(values) for values in rows}) != 1:
            wanted = ", ".join(f"(N, {size})" for size in sizes)
            raise ValueError(f"expected arrays of {wanted}, got {', '.join(str(each.shape) for each in rows)}")
        return function(np, parameters, columns, *rows)

    return run


def prepared(xp: Any, parameters: Parameters) -> dict[str, Any]:
    """Stored parameters as the networks below take them.

    Weights (outputs, inputs) are transposed, the bounds of the log-std become rows for mean and log-std, and numbered
    layers a list of weights and biases.
    """
    ready = {
        name: xp.ascontiguousarray(array.T) if name.endswith(".weight") else array[()]  # scalars are faster so
        for name, array in parameters.items()
    }
    of_objects = [name for name in parameters if name.endswith(".by_object")]
    ready |= {name: xp.asarray(parameters[name], dtype=xp.int64) for name in of_objects}
    for squash, bias in (("squash", "output.bias"), ("primitives.squash", "primitives.output_bias")):
        if bias in parameters:
            low, high = ready.pop(f"{squash}.log_std_min"), ready.pop(f"{squash}.log_std_max")
            num_actions = parameters[bias].shape[-1] // 2
            ready[f"{squash}.low"] = xp.repeat(xp.stack([0.0 * low - MEAN_BOUND, low]), num_actions)
            ready[f"{squash}.span"] = xp.repeat(xp.stack([0.0 * low + 2.0 * MEAN_BOUND, high - low]), num_actions)
    places = {name.rpartition(".")[0].rpartition(".") for name in parameters}
    for layers in {layers for layers, _, place in places if place.isdigit()}:
        numbers = sorted(int(place) for other, _, place in places if other == layers)
        ready[layers] = [(ready[f"{layers}.{place}.weight"], ready[f"{layers}.{place}.bias"]) for place in numbers]
    return ready


def bob(xp: Any, parameters: Parameters, columns: Columns, observation: Array) -> Outputs:
    """Compose the primitives by the gate's weights; the gate alone sees the goal."""
    weights = gate(xp, parameters, columns, observation)
    means, variances = primitives(xp, parameters, observation[:, columns["positions"]])
    action = xp.clip(compose(weights, means, variances)[0], -1.0, 1.0)
    return {"action": action, "weights": weights, "means": means, "variances": variances}


def monolithic(xp: Any, parameters: Parameters, columns: Columns, observation: Array) -> Outputs:
    """Act by one network without primitives."""
    return {"action": xp.clip(gaussian(xp, parameters, observation)[0], -1.0, 1.0)}


def primitive(xp: Any, parameters: Parameters, columns: Columns, positions: Array) -> Outputs:
    """Act by one primitive, which does not see the goal."""
    means, variances = primitives(xp, parameters, positions)
    return {"action": xp.clip(means[:, 0], -1.0, 1.0), "mean": means[:, 0], "variance": variances[:, 0]}


def orchestrator(
    xp: Any, parameters: Parameters, columns: Columns, previous_positions: Array, observation: Array
) -> Outputs:
    """Compose the primitives by weights that were learned for a task, from positions now and one step ago."""
    positions, goal = observation[:, columns["positions"]], observation[:, columns["goal"]]
    features = [positions]
    features += [positions[:, columns[name]] - previous_positions[:, columns[name]] for name in ("effector", "object")]
    features += [goal, goal - positions[:, columns["object"]]]
    seen = xp.concatenate(features, 1)
    seen = _normalised(xp, seen, parameters, "actor.input")
    output = relu_layers(xp, parameters["actor.layers"], seen)
    chosen = xp.tanh(output[:, : output.shape[1] // 2])
    means, variances = primitives(xp, parameters, positions)
    num_primitives = means.shape[1]
    weights = action_weights(xp, chosen[:, :num_primitives])
    action = compose(weights, means, variances)[0]
    if chosen.shape[1] > num_primitives:  # a small action of its own is added
        action = action + parameters["actor.residual"] * chosen[:, num_primitives:]
    return {"action": xp.clip(action, -1.0, 1.0), "weights": weights, "means": means, "variances": variances}


FUNCTIONS: Mapping[str, Callable[..., Outputs]] = {
    each.__name__: each for each in (bob, monolithic, primitive, orchestrator)
}
"""What is exported, by the names in files of parameters."""


def gaussian(xp: Any, parameters: Parameters, observation: Array) -> tuple[Array, Array]:
    """Mean and log-std, (N, A) each, of Alice or a monolithic Bob at (N, O) observations."""
    hidden = _normalised(xp, observation, parameters, "input")
    hidden = _elu_layers(xp, parameters["hidden"], hidden)
    output = _linear(hidden, parameters["output.weight"], parameters["output.bias"])
    return _halves(_squash(xp, output, parameters["squash.low"], parameters["squash.span"]))


def primitives(xp: Any, parameters: Parameters, positions: Array) -> tuple[Array, Array]:
    """Means and variances, (N, K, A) each, at (N, P) positions; the K heads share one matrix product per layer."""
    trunk = _normalised(xp, positions, parameters, "primitives.input")
    trunk = _elu_layers(xp, parameters["primitives.trunk"], trunk)
    hidden = _elu(xp, _linear(trunk, parameters["primitives.hidden.weight"], parameters["primitives.hidden.bias"]))
    weight = parameters["primitives.output_weight"]
    heads = hidden.reshape(-1, weight.shape[0], weight.shape[1]).swapaxes(0, 1)
    output = _linear(heads, weight, parameters["primitives.output_bias"][:, None])  # (K, N, 2A)
    output = _squash(xp, output, parameters["primitives.squash.low"], parameters["primitives.squash.span"])
    means, log_stds = _halves(output)
    log_stds *= 2.0
    return means.swapaxes(0, 1), xp.exp(log_stds, out=log_stds).swapaxes(0, 1)


def gate(xp: Any, parameters: Parameters, columns: Columns, observation: Array) -> Array:
    """Weights (N, K) at (N, O) observations: each in [floor, 1], and not of sum one, as in the paper."""
    way = observation[:, columns["goal"]] - observation[:, columns["object"]]
    hidden = xp.concatenate((observation, way), 1)
    hidden = _normalised(xp, hidden, parameters, "gate.input")
    hidden = _elu_layers(xp, parameters["gate.hidden"], hidden)
    floor = parameters["gate.weight_floor"]
    output = _linear(hidden, parameters["gate.output.weight"], parameters["gate.output.bias"])
    return _squash(xp, output, floor, 1.0 - floor)


def compose(weights: Array, means: Array, variances: Array) -> tuple[Array, Array]:
    """Multiply K diagonal Gaussians, each raised to its weight, and normalise (Peng et al. 2019, eq. 4).

    ``1 / variance = sum_k w_k / variance_k`` and ``mean = variance * sum_k w_k / variance_k * mean_k``, so the mean
    is a convex combination of the primitives' means, and scaling all weights scales the variance alone. The paper's
    sigma is a variance.

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


def action_weights(xp: Any, actions: Array) -> Array:
    """Weights ``100 ** ((a - 1) / 2)`` of (..., K) actions in [-1, 1]: equal actions, equal weights.

    A linear scale would be its upper half nearly everywhere: a weight has to be 100 times another for its primitive to
    decide alone.
    """
    return xp.exp(math.log(WEIGHT_RATIO) * (0.5 * (actions - 1.0)))


def relu_layers(xp: Any, layers: Layers, rows: Array) -> Array:
    """Affine maps with ReLU between them, (N, inputs) to (N, outputs)."""
    *hidden, (last, last_bias) = layers
    for weight, bias in hidden:
        rows = xp.maximum(rows @ weight + bias, 0.0)
    return rows @ last + last_bias


def _elu_layers(xp: Any, layers: Layers, rows: Array) -> Array:
    for weight, bias in layers:
        rows = _elu(xp, _linear(rows, weight, bias))
    return rows


def _normalised(xp: Any, rows: Array, parameters: Parameters, name: str) -> Array:
    if f"{name}.by_object" in parameters:
        rows = _nearest_first(xp, rows, parameters[f"{name}.by_object"])
    rows = rows - parameters[f"{name}.offset"]
    rows /= parameters[f"{name}.scale"]
    rows = xp.maximum(rows, -INPUT_CLIP, out=rows)
    return xp.minimum(rows, INPUT_CLIP, out=rows)


def _nearest_first(xp: Any, rows: Array, by_object: Array) -> Array:
    """Sort what (N, O) rows have of objects that are alike, (M, n) columns, by their distance from the end effector.

    The first three numbers of each are its way from there.
    """
    objects, rows = rows[:, by_object], xp.copy(rows)
    order = xp.argsort((objects[:, :, :3] ** 2).sum(-1), axis=1, kind="stable")
    rows[:, by_object] = xp.take_along_axis(objects, order[:, :, None], axis=1)
    return rows


def _linear(rows: Array, weight: Array, bias: Array) -> Array:
    output = rows @ weight
    output += bias
    return output


def _halves(values: Array) -> tuple[Array, Array]:
    half = values.shape[-1] // 2
    return values[..., :half], values[..., half:]


def _elu(xp: Any, values: Array) -> Array:
    """ELU in place. For x < 0, exp(x) - 1 >= x, and for x >= 0 the first term is 0: a maximum picks the branch."""
    negative = xp.minimum(values, 0.0)
    negative = xp.exp(negative, out=negative)
    negative -= 1.0
    return xp.maximum(values, negative, out=values)


def _squash(xp: Any, values: Array, low: Array, span: Array) -> Array:
    """``low + span * sigmoid(x)`` in place, by way of tanh, which does not overflow.

    The mean's ``2 tanh(x / 2)`` is ``-2 + 4 sigmoid(x)``.
    """
    values *= 0.5
    values = xp.tanh(values, out=values)
    values += 1.0
    values *= 0.5 * span
    values += low
    return values
