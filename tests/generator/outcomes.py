"""Rounds as the task generator hears of them, of which each test states only what matters to it."""

from __future__ import annotations

from typing import Any

import numpy as np

from service.base.types import Array, BoolArray, Metrics, StateArray
from service.envs.state_layout import StateLayout
from service.generator.bins import GoalCells, TaskBins
from service.generator.generator import TaskGenerator
from service.generator.records import GoalRecords, GoalSummary, summarize
from service.generator.ring import Rows
from service.generator.validity import Verdict

FREE = StateLayout(positions={"object": 3}, velocities={}, measured={"contacts": 2}, kept={"gripper_blocked": 0})
SOME_BLOCKED = StateLayout(
    positions={}, velocities={}, measured={"contacts": 2}, kept={"gripper_blocked": 1, "object_mass": 2}
)
"""Two small worlds of six numbers; contacts are elsewhere, and the flag is not the last of them."""
STATE_SIZE = FREE.size


def make_states(
    num: int,
    layout: StateLayout = FREE,
    *,
    mark: float | Array = 0.0,
    held: bool | BoolArray = False,
    blocked: bool | BoolArray = False,
) -> StateArray:
    """(N, S) states by whose time, their first number, a test knows them again; zeros, but for what is asked."""
    states = np.zeros((num, layout.size))
    states[:, 0] = mark
    states[:, layout["contacts"]] = np.reshape(held, (-1, 1))
    states[:, layout["gripper_blocked"]] = np.reshape(blocked, (-1, 1))
    return states


def make_records(proposal: Any, **overrides: Any) -> GoalRecords:
    """N valid goals of second rounds, from the origin, played as proposed by the current players and failed."""
    proposal = np.asarray(proposal, dtype=np.float64)
    proposal = proposal.reshape(-1, proposal.shape[-1] or 3)
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
        "round_index": np.ones(num, dtype=np.int64),
    }
    return GoalRecords(**{**fields, **{name: np.asarray(value) for name, value in overrides.items()}})


def make_starts(states: StateArray, position: Any = (0.0, 0.0, 0.025)) -> Rows:
    """Starts in (N, S) states with the object at a position."""
    return {"start_state": states, "start_position": np.tile(position, (len(states), 1))}


def only_starts(starts: Rows, *, round_index: int = 0) -> GoalRecords:
    """Worlds that began a round somewhere, in which Alice then threw the object off the table: nothing was played."""
    num = len(starts["start_state"])
    fallen, no = np.full(num, Verdict.FALLEN, dtype=np.int8), np.zeros(num, dtype=np.bool_)
    return make_records(
        np.full((num, 3), np.nan), **starts, verdict=fallen, played=no, round_index=np.full(num, round_index)
    )


def summary_of(
    records: GoalRecords, cells: GoalCells, tasks: TaskBins, starts: Rows | None = None, **limits: int
) -> GoalSummary:
    """Summary of a round that began where Bob's turns did, unless ``starts`` are given; all is kept without limits.

    The object was nowhere but at its goals.
    """
    starts = starts or {"start_state": records.start_state, "start_position": records.start_position}
    most = {"max_goals": 10**6, "max_starts": 10**6} | limits
    reached = cells.count(cells.index(records.proposal[records.verdict == Verdict.VALID]))
    return summarize(records, starts, reached, cells, tasks, rng=np.random.default_rng(0), **most)


def record(generator: TaskGenerator, records: GoalRecords, starts: Rows | None = None) -> Metrics:
    """Tell a generator of an iteration of one round."""
    return generator.record(summary_of(records, generator.cells, generator.tasks, starts))
