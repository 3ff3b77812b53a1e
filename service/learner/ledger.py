"""Which rollouts were learned from: each counts once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

RolloutId = tuple[int, int, int]


class Ledger:
    """The highest sequence number counted of each incarnation of each actor; an actor's rollouts come in order."""

    def __init__(self) -> None:
        """Start with nothing counted."""
        self._highest: dict[tuple[int, int], int] = {}

    def __contains__(self, rollout: RolloutId) -> bool:
        """Whether this (actor, incarnation, sequence), or a later one of that incarnation, was counted."""
        *source, sequence = rollout
        return sequence <= self._highest.get((source[0], source[1]), -1)

    def add(self, rollout: RolloutId) -> None:
        """Count a rollout."""
        actor, incarnation, sequence = rollout
        self._highest[actor, incarnation] = max(sequence, self._highest.get((actor, incarnation), -1))

    def state(self) -> NDArray[np.int64]:
        """Rows of actor, incarnation, highest sequence."""
        rows = [(*source, sequence) for source, sequence in sorted(self._highest.items())]
        return np.array(rows, dtype=np.int64).reshape(-1, 3)

    def load_state(self, state: NDArray[np.int64]) -> None:
        """Continue where ``state`` was taken."""
        self._highest = {(int(actor), int(incarnation)): int(sequence) for actor, incarnation, sequence in state}
