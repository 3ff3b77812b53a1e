"""Named arrays: nested by their names, and to safetensors bytes and back, bit-exactly and without torch."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from service.base.parsing import parse_json

_SIZED = ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float16", "float32", "float64")
DTYPES = ("bool", *_SIZED, "complex64")
Each = TypeVar("Each")


def encode(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str] | None = None) -> bytes:
    """The arrays as safetensors bytes; equal arrays give equal bytes.

    Args:
        arrays: any shape, 0-d and empty included, any memory order, dtypes as in `DTYPES`.
        metadata: text for the file's header. More than one key would make the bytes depend on a hash order.

    Raises:
        ValueError: a dtype that safetensors cannot hold.
    """
    assert metadata is None or len(metadata) == 1
    for name, array in arrays.items():
        if np.asarray(array).dtype.name not in DTYPES:
            raise ValueError(f"array {name!r} has dtype {np.asarray(array).dtype}; use one of {', '.join(DTYPES)}")
    # asarray keeps 0-d arrays 0-d, which ascontiguousarray does not
    plain = {name: np.asarray(arrays[name], order="C") for name in sorted(arrays)}
    return save(plain, metadata=dict(metadata) if metadata is not None else None)


def decode(data: bytes) -> dict[str, np.ndarray]:
    """The arrays of safetensors bytes, sorted by name, each writable and on its own memory.

    Raises:
        ValueError: not safetensors, or cut short.
    """
    try:
        arrays = load(data)
    except (SafetensorError, KeyError) as error:
        raise ValueError(f"not a whole safetensors file: {error}") from None
    return {name: arrays[name].copy() for name in sorted(arrays)}


def read_metadata(data: bytes, key: str) -> str:
    """A text in the header of safetensors bytes.

    Raises:
        ValueError: not safetensors.
        KeyError: it has no such text.
        TypeError: the header is something else.
    """
    length = int.from_bytes(data[:8], "little")
    text: str = parse_json(data[8 : 8 + length], "the header")["__metadata__"][key]
    return text


def digest_of(text: str, arrays: Mapping[str, np.ndarray]) -> str:
    """sha256 over a text and the arrays' names, dtypes, shapes and bytes; independent of the file's layout."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        array = np.asarray(arrays[name], order="C")
        digest.update(json.dumps([name, array.dtype.name, array.shape]).encode())
        digest.update(array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes())
    return digest.hexdigest()


def join_parts(parts: Mapping[str, Mapping[str, Each]]) -> dict[str, Each]:
    """What several parts hold, arrays or tensors, each named ``PART/NAME``."""
    return {f"{part}/{name}": array for part, arrays in parts.items() for name, array in arrays.items()}


def split_parts(arrays: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """The arrays of each part by their names in it: the inverse of ``join_parts``."""
    parts: dict[str, dict[str, np.ndarray]] = {}
    for key, array in arrays.items():
        part, _, name = key.partition("/")
        parts.setdefault(part, {})[name] = array
    return parts
