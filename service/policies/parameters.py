"""Exported parameters: copies to act by, and the error of those that make no policy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import numpy as np

from service.base.errors import TandemError
from service.base.types import FloatArray

Parameters = Mapping[str, FloatArray]


class PolicyError(TandemError):
    """Parameters or inputs that do not fit the policy; the message says what does not fit."""


def checked(parameters: Parameters) -> dict[str, FloatArray]:
    """Float32 copies of parameters.

    Raises:
        PolicyError: a parameter is not of floats, or not finite.
    """
    for name, value in parameters.items():
        about = f"policy parameter {name!r}"
        if value.dtype.kind != "f":
            raise PolicyError(f"{about} of shape {value.shape}: expected float32, got {value.dtype}")
        if not np.isfinite(value).all():
            raise PolicyError(f"{about} of shape {value.shape} is not finite; use an earlier version")
    return {name: value.astype(np.float32) for name, value in parameters.items()}


@contextmanager
def fitting() -> Iterator[None]:
    """Make a policy of parameters inside, and act once by it: an error says that they do not fit together.

    Raises:
        PolicyError: a parameter is missing, or its shape does not fit the others.
    """
    try:
        yield
    except PolicyError:
        raise
    except (LookupError, TypeError, ValueError) as error:
        words = f"{type(error).__name__}: {error}"
        raise PolicyError(f"policy parameters do not fit together ({words}); export them again") from error
