"""Array types that every package shares."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]
"""Inputs and outputs of networks."""
StateArray = NDArray[np.float64]
"""Physics states and positions."""
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
Array = NDArray[Any]
Arrays = dict[str, Array]
"""Named arrays, such as the state of a part in a checkpoint."""
Metrics = dict[str, float]
"""Metrics by name, such as ``bob/success_rate``."""
