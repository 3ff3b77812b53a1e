"""The check of arrays that a checkpoint gives back."""

from __future__ import annotations

from collections.abc import Mapping

from service.base.errors import ConfigError
from service.base.types import Array


def take(state: Mapping[str, Array], name: str, like: Array, *, any_rows: bool = False) -> Array:
    """A copy of one array, checked against an array of the receiver.

    Args:
        state: named arrays.
        name: which one.
        like: array of the expected type and shape.
        any_rows: the first axis may have another length.

    Raises:
        ConfigError: missing, or of another type or shape, as after a change of the configuration.
    """
    if name not in state:
        raise ConfigError(f"generator state: array {name!r} is missing; resume from another checkpoint")
    array = state[name]
    skip = 1 if any_rows else 0
    if array.dtype != like.dtype or array.ndim != like.ndim or array.shape[skip:] != like.shape[skip:]:
        raise ConfigError(
            f"generator state: array {name!r} is {array.dtype} {array.shape}, this configuration needs {like.dtype} "
            f"{like.shape}; resume with the configuration of the checkpoint"
        )
    return array.copy()
