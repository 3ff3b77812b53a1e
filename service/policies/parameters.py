"""Exported parameters, as torch and NumPy share them: constants of the architecture, and a reader that checks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from service.errors import TandemError
from service.types import FloatArray

Parameters = Mapping[str, FloatArray]

INPUT_CLIP = 5.0
"""Normalised inputs are clipped to +- this."""
MEAN_BOUND = 2.0
"""Means are ``MEAN_BOUND * tanh(x / MEAN_BOUND)``: slope 1 at 0, and a little room past the action's [-1, 1]."""


class PolicyError(TandemError):
    """Parameters or inputs that do not fit the policy; the message names them, with expected and actual shape."""


class ParameterReader:
    """Reader of an exported dict: parameters are taken one by one and checked; ``finish`` tells of any left over."""

    def __init__(self, parameters: Parameters) -> None:
        """Read from ``parameters``, which stays as it is."""
        self._left: dict[str, Any] = dict(parameters)

    def __contains__(self, name: str) -> bool:
        """Whether ``name`` is there and not yet taken."""
        return name in self._left

    def take(self, name: str, shape: tuple[int | None, ...]) -> FloatArray:
        """Take one parameter as a float32 copy.

        Args:
            name: key of the exported dict.
            shape: expected shape; None stands for any size of at least 1.

        Raises:
            PolicyError: missing, of another shape, not floating point, or not finite.
        """
        expected = _describe(shape)
        if name not in self._left:
            raise PolicyError(f"policy parameter {name!r} is missing, expected shape {expected}; export it again")
        value = np.asarray(self._left.pop(name))
        fits = len(shape) == value.ndim and all(
            actual == size or (size is None and actual > 0) for size, actual in zip(shape, value.shape, strict=True)
        )
        if not fits:
            actual = _describe(value.shape)
            raise PolicyError(f"policy parameter {name!r}: expected shape {expected}, got {actual}; export it again")
        if value.dtype.kind != "f":
            raise PolicyError(f"policy parameter {name!r} of shape {expected}: expected float32, got {value.dtype}")
        if not np.isfinite(value).all():
            raise PolicyError(f"policy parameter {name!r} of shape {expected} is not finite; use an earlier version")
        return value.astype(np.float32)

    def take_scalar(self, name: str, low: float, high: float) -> np.float32:
        """Take a 0-d parameter strictly between ``low`` and ``high``.

        Raises:
            PolicyError: as ``take``, or the value is out of range.
        """
        value: np.float32 = self.take(name, ())[()]  # type: ignore[assignment]  # indexing by () gives the scalar
        if not low < value < high:
            raise PolicyError(f"policy parameter {name!r} = {value}: expected a value between {low:g} and {high:g}")
        return value

    def finish(self) -> None:
        """Assert that every parameter was taken.

        Raises:
            PolicyError: some were not.
        """
        if self._left:
            name, value = next(iter(self._left.items()))
            more = f" (and {len(self._left) - 1} more)" if len(self._left) > 1 else ""
            actual = _describe(np.shape(value))
            raise PolicyError(f"policy parameter {name!r}: expected none of that name, got shape {actual}{more}")


def _describe(shape: tuple[int | None, ...]) -> str:
    sizes = ", ".join("any" if size is None else str(size) for size in shape)
    return f"({sizes},)" if len(shape) == 1 else f"({sizes})"
