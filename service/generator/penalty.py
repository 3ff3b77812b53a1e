"""When goals outside the workspace begin to cost Alice something.

A penalty from the first step can teach her never to touch the object; once she proposes valid goals often, it keeps her
from throwing the object away.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from service.generator.state import Array, State, take

_SMOOTHING = 0.9
"""Share of the old value kept at each iteration: about ten iterations are averaged."""


class OutsidePenalty:
    """Sets in for good once the smoothed share of valid goals has passed a threshold."""

    active: bool
    """Whether ``game.alice_outside_reward`` is paid."""

    def __init__(self, from_valid_fraction: float) -> None:
        self._threshold = from_valid_fraction
        self._valid_fraction = 0.0
        self.active = from_valid_fraction == 0.0

    def record(self, valid_fraction: float) -> None:
        """Add one iteration's share of valid goals."""
        self._valid_fraction = _SMOOTHING * self._valid_fraction + (1.0 - _SMOOTHING) * valid_fraction
        self.active = self.active or self._valid_fraction >= self._threshold

    def state(self) -> State:
        """Everything, copied."""
        return {"valid_fraction": np.array(self._valid_fraction), "active": np.array(self.active)}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave.

        Raises:
            ConfigError: an array is missing.
        """
        self._valid_fraction = float(take(state, "valid_fraction", np.array(0.0)))
        self.active = bool(take(state, "active", np.array(False)))
