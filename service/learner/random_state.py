"""A NumPy PCG64 generator as an array: its 128-bit state and increment in halves, then its buffered half-draw."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_LOW = (1 << 64) - 1


def dump(rng: np.random.Generator) -> NDArray[np.uint64]:
    """Six words (6,)."""
    state = rng.bit_generator.state
    assert state["bit_generator"] == "PCG64", f"expected PCG64, got {state['bit_generator']}"
    wide = (word for value in state["state"].values() for word in (value >> 64, value & _LOW))
    return np.array([*wide, state["has_uint32"], state["uinteger"]], dtype=np.uint64)


def load(words: NDArray[np.uint64]) -> np.random.Generator:
    """The generator that ``dump`` made these (6,) words of."""
    values = [int(word) for word in words]
    rng = np.random.Generator(np.random.PCG64())
    rng.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": values[0] << 64 | values[1], "inc": values[2] << 64 | values[3]},
        "has_uint32": values[4],
        "uinteger": values[5],
    }
    return rng
