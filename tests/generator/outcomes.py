"""Rounds as the task generator hears of them, of which each test states only what matters to it."""

from __future__ import annotations

from typing import Any

import numpy as np

from service.base.types import Metrics
from service.generator.bins import GoalCells, TaskBins
from service.generator.generator import TaskGenerator
from service.generator.records import GoalRecords, GoalSummary, summarize
from service.generator.ring import Rows
from service.generator.validity import Verdict

STATE_SIZE = 4


def make_records(proposal: Any, **overrides: Any) -> GoalRecords:
    """N valid goals, played as proposed by the current players and failed, from an object at the origin."""
    proposal = np.asarray(proposal, dtype=np.float64).reshape(-1, 3)
    num = len(proposal)
    fields: dict[str, Any] = {
        "start_state": np.zeros((num, STATE_SIZE)),
        "start_position": np.tile([0.0, 0.0, 0.025], (num, 1)),
        "goal": proposal,
        "proposal": proposal,
        "verdict": np.zeros(num, dtype=np.int8),
        "replayed": np.zeros(num, dtype=np.bool_),
        "from_reset": np.zeros(num, dtype=np.bool_),
        "played": np.ones(num, dtype=np.bool_),
        "solved": np.zeros(num, dtype=np.bool_),
        "num_bob_steps": np.full(num, 40),
        "alice_past": np.zeros(num, dtype=np.bool_),
        "bob_past": np.zeros(num, dtype=np.bool_),
        "round_index": np.zeros(num, dtype=np.int64),
    }
    return GoalRecords(**{**fields, **{name: np.asarray(value) for name, value in overrides.items()}})


def starts_of(*states: list[float]) -> Rows:
    """Games that begin in these states, with the object at (0, 0, 0.025)."""
    return {
        "start_state": np.array(states, dtype=np.float64),
        "start_position": np.tile([0.0, 0.0, 0.025], (len(states), 1)),
    }


def summary_of(
    records: GoalRecords, cells: GoalCells, tasks: TaskBins, starts: Rows | None = None, **limits: int
) -> GoalSummary:
    """Summary of a round in which no game began, unless ``starts`` are given; nothing is left out without limits.

    The object was nowhere but at its goals.
    """
    none = {"start_state": np.zeros((0, records.start_state.shape[1])), "start_position": np.zeros((0, 3))}
    most = {"max_goals": 10**6, "max_starts": 10**6} | limits
    reached = cells.count(records.proposal[records.verdict == Verdict.VALID])
    return summarize(records, starts or none, reached, cells, tasks, rng=np.random.default_rng(0), **most)


def record(generator: TaskGenerator, records: GoalRecords, starts: Rows | None = None) -> Metrics:
    """Tell a generator of an iteration of one round."""
    return generator.record(summary_of(records, generator.cells, generator.tasks, starts))
