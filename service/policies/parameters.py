"""Exported parameters: the shapes that networks need, declared once, and a check."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from service.base.errors import TandemError
from service.base.types import FloatArray
from service.envs.observations import ACTION

Parameters = Mapping[str, FloatArray]
Shapes = dict[str, tuple[int, ...]]


class PolicyError(TandemError):
    """Parameters or inputs that do not fit the policy; the message names them, with expected and actual shape."""


def bob_shapes(
    num_positions: int,
    num_goal: int,
    trunk: Sequence[int],
    heads: tuple[int, int],
    gate: Sequence[int],
) -> Shapes:
    """Shape of every parameter of a composed Bob.

    Args:
        num_positions: P.
        num_goal: 3 for each object.
        trunk: sizes of the layers that the primitives share.
        heads: number of primitives, and hidden size of each.
        gate: sizes of the gate's hidden layers.
    """
    num_primitives, head_size = heads
    num_seen = num_positions + 2 * num_goal  # and the ways to the goals
    last_of_trunk, last_of_gate = [num_positions, *trunk][-1], [num_seen, *gate][-1]
    return {
        **_input_shapes("primitives.input", num_positions),
        **layer_shapes("primitives.trunk.{}", (num_positions, *trunk)),
        **layer_shapes("primitives.hidden", (last_of_trunk, num_primitives * head_size)),
        "primitives.output_weight": (num_primitives, head_size, 2 * ACTION.size),
        "primitives.output_bias": (num_primitives, 2 * ACTION.size),
        **_squash_shapes("primitives.squash"),
        **_input_shapes("gate.input", num_seen),
        **layer_shapes("gate.hidden.{}", (num_seen, *gate)),
        **layer_shapes("gate.output", (last_of_gate, num_primitives)),
        "gate.weight_floor": (),
    }


def gaussian_shapes(num_inputs: int, hidden: Sequence[int]) -> Shapes:
    """Shape of every parameter of Alice, or of a monolithic Bob."""
    return {
        **_input_shapes("input", num_inputs),
        **layer_shapes("hidden.{}", (num_inputs, *hidden)),
        **layer_shapes("output", ([num_inputs, *hidden][-1], 2 * ACTION.size)),
        **_squash_shapes("squash"),
    }


def order_shapes(parameters: Parameters) -> Shapes:
    """Shapes of the columns by object that are there, of networks that see the nearest object first.

    Raises:
        PolicyError: they are no columns of their inputs.
    """
    names = [name for name in parameters if name.endswith("input.by_object")]
    for name in names:
        shape_of(parameters, name, 2)
        columns, (num,) = parameters[name], shape_of(parameters, name.replace("by_object", "offset"), 1)
        if not np.isin(columns, np.arange(num)).all() or len(np.unique(columns)) < columns.size:
            raise PolicyError(
                f"policy parameter {name!r}: expected different columns from 0 to {num - 1}; export it again"
            )
    return {name: np.shape(parameters[name]) for name in names}


def layer_shapes(name: str, sizes: Sequence[int], step: int = 1) -> Shapes:
    """Weights (outputs, inputs) and biases between every two neighbours of ``sizes``.

    Args:
        name: with ``{}`` for the place of a layer.
        sizes: inputs, then outputs of each layer.
        step: from one place to the next.
    """
    shapes: Shapes = {}
    for place, (inputs, outputs) in enumerate(pairwise(sizes)):
        layer = name.format(step * place)
        shapes |= {f"{layer}.weight": (outputs, inputs), f"{layer}.bias": (outputs,)}
    return shapes


def layer_sizes(parameters: Parameters, name: str, step: int = 1) -> tuple[int, ...]:
    """Outputs of each layer that is there; see ``layer_shapes``.

    Raises:
        PolicyError: the first is missing, or a weight is no matrix.
    """
    sizes: list[int] = []
    while not sizes or f"{name.format(step * len(sizes))}.weight" in parameters:
        sizes.append(shape_of(parameters, f"{name.format(step * len(sizes))}.weight", 2)[0])
    return tuple(sizes)


def shape_of(parameters: Parameters, name: str, num_axes: int) -> tuple[int, ...]:
    """Shape of a parameter that sizes are read from.

    Raises:
        PolicyError: it is missing, or has another number of axes.
    """
    if name not in parameters:
        raise PolicyError(f"policy parameter {name!r} is missing; export it again")
    shape = np.shape(parameters[name])
    if len(shape) != num_axes or 0 in shape:
        raise PolicyError(f"policy parameter {name!r}: expected {num_axes} axes, got {shape}; export it again")
    return shape


def checked(parameters: Parameters, expected: Shapes) -> dict[str, FloatArray]:
    """Float32 copies of parameters that have the expected shapes.

    Raises:
        PolicyError: a parameter is missing, left over, of another shape, or not finite.
    """
    for name in [*expected, *(name for name in parameters if name not in expected)]:
        if name not in parameters:
            raise PolicyError(f"policy parameter {name!r} is missing, expected shape {expected[name]}; export it again")
        if (shape := np.shape(parameters[name])) != expected.get(name):
            wanted = f"shape {expected[name]}" if name in expected else "none of that name"
            raise PolicyError(f"policy parameter {name!r}: expected {wanted}, got {shape}; export it again")
    for name, value in parameters.items():
        about = f"policy parameter {name!r}"
        if value.dtype.kind != "f":
            raise PolicyError(f"{about} of shape {value.shape}: expected float32, got {value.dtype}")
        if not np.isfinite(value).all():
            raise PolicyError(f"{about} of shape {value.shape} is not finite; use an earlier version")
    return {name: value.astype(np.float32) for name, value in parameters.items()}


def _input_shapes(name: str, size: int) -> Shapes:
    return {f"{name}.offset": (size,), f"{name}.scale": (size,)}


def _squash_shapes(name: str) -> Shapes:
    return {f"{name}.log_std_min": (), f"{name}.log_std_max": ()}
