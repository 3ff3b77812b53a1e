"""Summary of the goals of a round for the task generator: sums over all of them, and a sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from service.base.types import BoolArray, IntArray, StateArray
from service.generator.bins import GoalCells, TaskBins
from service.generator.records import (
    GOALS_PER_ITERATION,
    GoalRecords,
    Sums,
    alice_sums,
    bob_sums,
    count_heights,
    sampled_goals,
    sum_up,
)
from service.generator.ring import Rows, join_rows
from service.generator.validity import Verdict

_COUNTS = ("proposed", "tries", "successes", "reset_tries", "reset_successes", "heights")


@dataclass(frozen=True, slots=True)
class GoalSummary:
    """The goals of one round or of several: sums, whose size depends on no number of worlds, and a bounded sample."""

    proposed: IntArray
    """(cells,) valid proposals, a past Alice's included."""
    tries: IntArray
    """(cells,) tries of the current Bob, but for replays from the start of a game."""
    successes: IntArray
    """(cells,) of these tries."""
    reset_tries: IntArray
    """(task bins,) tries of the current Bob from where a game starts."""
    reset_successes: IntArray
    """(task bins,) of these tries."""
    metrics: Sums
    """``alice/*`` and ``bob/*`` metrics."""
    heights: IntArray
    """(H,) of ``count_heights``."""
    goals: Rows
    """(M,) valid ``goal`` that Bob played straight from Alice, with ``start_state`` and ``start_position``."""
    starts: Rows
    """``start_state`` and ``start_position`` of the games that began."""
    shown: StateArray
    """(L, 7) of ``sampled_goals``, for the run directory."""


def summarize(
    records: GoalRecords,
    starts: Rows,
    cells: GoalCells,
    tasks: TaskBins,
    *,
    max_goals: int,
    max_starts: int,
    rng: np.random.Generator,
) -> GoalSummary:
    """Sum up the goals of a round.

    Difficulty follows every try of the current Bob; the buffer takes the valid goals that Bob played straight from
    Alice; a cell is new when a valid proposal, a past Alice's included, is the first in it.

    Args:
        records: of the round.
        starts: of the games that began with it.
        cells: of goals.
        tasks: bins of tasks from resets.
        max_goals: of more new goals for the buffer, so many are drawn at random.
        max_starts: of more starts of games, so many are drawn at random.
        rng: source of the draw; it is left alone where all are kept.
    """
    tried: BoolArray = records.played & ~records.bob_past
    reset: BoolArray = tried & records.from_reset
    as_proposed: BoolArray = tried & ~(records.replayed & records.from_reset)
    bins = tasks.index(records.goal[reset], records.start_position[reset], records.start_state[reset])
    sums = alice_sums(records, tasks.rest_height_m) | bob_sums(records, tasks.rest_height_m)
    if tasks.some_blocked:
        sums |= _blocked_sums(records, tried, tasks.blocked(records.start_state))
    kept = _some(np.flatnonzero(records.own), max_goals, rng)
    began = _some(np.arange(len(starts["start_position"])), max_starts, rng)
    return GoalSummary(
        proposed=cells.count(records.proposal[records.verdict == Verdict.VALID]),
        tries=cells.count(records.goal[as_proposed]),
        successes=cells.count(records.goal[as_proposed & records.solved]),
        reset_tries=np.bincount(bins, minlength=len(tasks)),
        reset_successes=np.bincount(bins[records.solved[reset]], minlength=len(tasks)),
        metrics=sums,
        heights=count_heights(records),
        goals={name: getattr(records, name)[kept] for name in ("start_state", "start_position", "goal")},
        starts={name: rows[began] for name, rows in starts.items()},
        shown=sampled_goals(records),
    )


def join_summaries(summaries: Sequence[GoalSummary]) -> GoalSummary:
    """Join the summaries of several rounds into one: sums are added up, samples put together."""
    parts: dict[str, list[Any]] = {
        field.name: [getattr(each, field.name) for each in summaries] for field in fields(GoalSummary)
    }
    return GoalSummary(
        **{name: np.sum(parts[name], axis=0) for name in _COUNTS},
        metrics=_join_sums(parts["metrics"]),
        goals=join_rows(parts["goals"]),
        starts=join_rows(parts["starts"]),
        shown=np.concatenate(parts["shown"])[:GOALS_PER_ITERATION],
    )


def _join_sums(sums: Sequence[Sums]) -> Sums:
    return {name: (sum(each[name][0] for each in sums), sum(each[name][1] for each in sums)) for name in sums[0]}


def _blocked_sums(records: GoalRecords, tried: BoolArray, blocked: BoolArray) -> Sums:
    valid: BoolArray = records.verdict[blocked & ~records.alice_past & ~records.replayed] == Verdict.VALID
    return sum_up({"alice/valid_fraction_blocked": valid, "bob/success_rate_blocked": records.solved[tried & blocked]})


def _some(rows: IntArray, num: int, rng: np.random.Generator) -> IntArray:
    """At most ``num`` of the rows, drawn at random, in their order."""
    return rows if len(rows) <= num else np.sort(rng.choice(rows, num, replace=False))
