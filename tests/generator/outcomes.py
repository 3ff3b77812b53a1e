"""Rounds as the task generator hears of them."""

from __future__ import annotations

import numpy as np

from service.base.types import Metrics
from service.generator.bins import GoalCells, TaskBins
from service.generator.generator import TaskGenerator
from service.generator.records import GoalRecords
from service.generator.ring import Rows
from service.generator.summary import GoalSummary, summarize


def starts_of(*states: list[float]) -> Rows:
    """Games that begin in these states, with the object at (0, 0, 0.025)."""
    return {
        "start_state": np.array(states, dtype=np.float64),
        "start_position": np.tile([0.0, 0.0, 0.025], (len(states), 1)),
    }


def summary_of(
    records: GoalRecords, cells: GoalCells, tasks: TaskBins, starts: Rows | None = None, **limits: int
) -> GoalSummary:
    """Summary of a round in which no game began, unless ``starts`` are given; nothing is left out without limits."""
    none = {"start_state": np.zeros((0, records.start_state.shape[1])), "start_position": np.zeros((0, 3))}
    most = {"max_goals": 10**6, "max_starts": 10**6} | limits
    return summarize(records, starts or none, cells, tasks, rng=np.random.default_rng(0), **most)


def record(generator: TaskGenerator, records: GoalRecords, starts: Rows | None = None) -> Metrics:
    """Tell a generator of an iteration of one round."""
    return generator.record(summary_of(records, generator.cells, generator.tasks, starts))
