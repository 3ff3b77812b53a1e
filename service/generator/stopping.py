"""Stop criterion: Alice finds nothing new and Bob solves all (the paper, section on task generation)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from service.base.types import Array, Arrays
from service.config.self_play import GeneratorConfig
from service.generator.state import take

MIN_NUM_GOALS = 100
"""Goals the window must hold before Bob's success rate says anything: its 95 % interval is then below +-10 points."""


class StopCriterion:
    """The paper's stop criterion over a window of iterations."""

    num_iterations_without_new_cell: int
    """Iterations since the last new goal cell."""

    def __init__(self, config: GeneratorConfig) -> None:
        self._stop_success_rate = config.stop_success_rate
        self._window = np.zeros((config.novelty_window, 2), dtype=np.int64)  # tries and successes of an iteration
        self._num_iterations = 0
        self.num_iterations_without_new_cell = 0

    def record(self, num_new_cells: int, num_tried: int, num_solved: int) -> None:
        """Add one iteration: new goal cells, and tries and successes of the current players' goals."""
        self._window[self._num_iterations % len(self._window)] = num_tried, num_solved
        self._num_iterations += 1
        self.num_iterations_without_new_cell = 0 if num_new_cells else self.num_iterations_without_new_cell + 1

    def should_stop(self) -> bool:
        """Whether, over a whole window, no cell was new and Bob solved enough of at least ``MIN_NUM_GOALS`` goals."""
        num_tried, num_solved = self._window.sum(axis=0)
        saturated = self.num_iterations_without_new_cell >= len(self._window)
        return bool(saturated and num_tried >= MIN_NUM_GOALS and num_solved >= self._stop_success_rate * num_tried)

    def state(self) -> Arrays:
        """Everything, copied."""
        counters = np.array([self._num_iterations, self.num_iterations_without_new_cell])
        return {"window": self._window.copy(), "counters": counters}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave.

        Raises:
            ConfigError: of another window.
        """
        self._window = take(state, "window", self._window)
        counters = take(state, "counters", np.zeros(2, dtype=np.int64))
        self._num_iterations, self.num_iterations_without_new_cell = int(counters[0]), int(counters[1])
