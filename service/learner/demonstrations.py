"""The demonstrations of the last iterations; D steps in all."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.actors.rollout import Demonstrations
from service.envs.observations import ACTION, BOB
from service.types import Arrays


class DemonstrationHistory:
    """Demonstrations of the last ``num_iterations`` iterations; one without demonstrations counts too."""

    def __init__(self, num_iterations: int) -> None:
        """Start empty."""
        self._iterations: deque[Demonstrations] = deque(maxlen=num_iterations)

    def append(self, demonstrations: Iterable[Demonstrations]) -> None:
        """Add one iteration, without steps that are not finite; the oldest one goes if there are too many."""
        new = _join(demonstrations)
        finite = np.isfinite(new.observation).all(1) & np.isfinite(new.action).all(1)
        self._iterations.append(Demonstrations(new.observation[finite], new.action[finite]))

    def joined(self) -> Demonstrations:
        """Join all that is kept, oldest first."""
        return _join(self._iterations)

    def state(self) -> Arrays:
        """Everything that a resumed run needs, by name."""
        everything = self.joined()
        sizes = np.array([len(each.action) for each in self._iterations], dtype=np.int64)
        return {"observation": everything.observation, "action": everything.action, "num_steps": sizes}

    def load_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue where ``state`` was taken; a shorter history keeps the newest."""
        self._iterations.clear()
        ends = np.cumsum(state["num_steps"])
        for start, end in zip(ends - state["num_steps"], ends, strict=True):
            rows = slice(int(start), int(end))
            self._iterations.append(Demonstrations(state["observation"][rows].copy(), state["action"][rows].copy()))


def _join(parts: Iterable[Demonstrations]) -> Demonstrations:
    observations = [np.zeros((0, BOB.size), dtype=np.float32), *(part.observation for part in parts)]
    actions = [np.zeros((0, ACTION.size), dtype=np.float32), *(part.action for part in parts)]
    return Demonstrations(np.concatenate(observations), np.concatenate(actions))
