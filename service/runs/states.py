"""States of methods as a checkpoint holds them: arrays by name, and plain values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from service.base.tensors import split_parts
from service.base.types import Arrays
from service.methods.method import State

_LOOSE = "&"
"""Component of the arrays of a state that lie beside plain values, and key of what stands there for one."""


def check_comes_back(state: State) -> None:
    """Refuse what a checkpoint would give back as something else.

    Raises:
        ValueError: a component with a slash in its name, keys that are no text, a tuple, or an object.
    """
    for name, part in state.items():
        if "/" in name or not name:
            raise ValueError(f"{name!r} has a slash, or no letters")
        _check_plain(name, part)


def _check_plain(name: str, part: object) -> None:
    if isinstance(part, tuple):
        raise ValueError(f"{name!r} has a tuple, which comes back as a list")
    if isinstance(part, Mapping):
        if not all(isinstance(key, str) for key in part):
            raise ValueError(f"{name!r} has keys that are no text")
        if _LOOSE in part:
            raise ValueError(f"{name!r} has the key {_LOOSE!r}, which is used here")
        for each in part.values():
            _check_plain(name, each)
    elif isinstance(part, list):
        for each in part:
            _check_plain(name, each)
    elif not isinstance(part, np.ndarray | np.generic | str | int | float | None):
        raise ValueError(f"{name!r} has a {type(part).__name__}")


def flatten(state: State) -> tuple[Arrays, dict[str, Any]]:
    """The arrays of a state as ``COMPONENT/NAME``, and its plain values by name.

    Arrays beside plain values or deeper, and NumPy's numbers, are in a component of their own.
    """
    arrays: Arrays = {}
    values: dict[str, Any] = {}
    loose: list[np.ndarray] = []

    def taken_out(part: Any) -> Any:
        if isinstance(part, np.ndarray | np.generic):
            loose.append(np.asarray(part))
            return {_LOOSE: str(len(loose) - 1), "is_number": isinstance(part, np.generic)}
        if isinstance(part, Mapping):
            return {key: taken_out(each) for key, each in part.items()}
        return [taken_out(each) for each in part] if isinstance(part, list) else part

    for name, part in state.items():
        if isinstance(part, Mapping) and part and all(isinstance(each, np.ndarray) for each in part.values()):
            arrays |= {f"{name}/{key}": array for key, array in part.items()}
        else:
            values[name] = taken_out(part)
    return arrays | {f"{_LOOSE}/{number}": array for number, array in enumerate(loose)}, values


def put_together(arrays: Arrays, values: Mapping[str, Any]) -> State:
    """The state of which ``flatten`` gave these."""
    parts = split_parts(arrays)
    loose = parts.pop(_LOOSE, {})
    return {**parts, **{name: _put_back(part, loose) for name, part in values.items()}}


def _put_back(part: Any, loose: Arrays) -> Any:
    """A plain value of a state with the arrays that ``flatten`` took out of it."""
    if isinstance(part, dict):
        if _LOOSE in part:
            array = loose[part[_LOOSE]]
            return array[()] if part["is_number"] else array
        return {key: _put_back(each, loose) for key, each in part.items()}
    return [_put_back(each, loose) for each in part] if isinstance(part, list) else part
