"""States of methods as a checkpoint holds them: arrays by name, and plain values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from service.base.tensors import DTYPES, split_parts
from service.base.types import Arrays
from service.methods.method import State

_LOOSE = "&"
"""Component of the arrays of a state that lie beside plain values, and key of what stands there for one."""


def check_comes_back(state: State) -> None:
    """Refuse what a checkpoint would give back as something else.

    Raises:
        ValueError: a name or key that is no text, empty or has a slash; a tuple; an array of what is no number; or an
            object.
    """
    for name, part in state.items():
        if not isinstance(name, str) or not name:
            raise ValueError(f"the name {name!r} is no text")
        if "/" in name:
            raise ValueError(f"{name!r} has a slash")
        if name == _LOOSE:
            raise ValueError(f"the name {name!r} is used here")
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
    elif isinstance(part, np.ndarray | np.generic):
        if part.dtype.name not in DTYPES or isinstance(part, np.ma.MaskedArray):
            what = "a mask" if isinstance(part, np.ma.MaskedArray) else f"dtype {part.dtype}"
            raise ValueError(f"{name!r} has an array with {what}; use one of {', '.join(DTYPES)}")
    elif not isinstance(part, str | int | float | None):
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
