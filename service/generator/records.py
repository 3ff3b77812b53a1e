"""Goals of a round: the record of each, both players' metrics, and the summary that goes to the task generator.

Metric names are an API.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.base.types import Array, BoolArray, IntArray, Metrics, StateArray
from service.config import WorldConfig
from service.envs.observations import distances, each_object
from service.generator.bins import (
    ARRANGEMENT_NAMES,
    HEIGHT_NAMES,
    NUM_ARRANGEMENTS,
    ONE_MOVED,
    GoalCells,
    TaskBins,
    height_bins,
    highest,
    in_air,
)
from service.generator.ring import Rows, join_rows
from service.generator.validity import Verdict

GOALS_PER_ITERATION = 32
"""Number of valid proposals kept for the run directory per iteration, at most."""
HEIGHT_STEP_M = 0.001
NUM_HEIGHT_STEPS = 801
"""Up to 0.8 m, the highest workspace there may be."""
Sums = dict[str, tuple[int, float]]
"""Number of cases and the sum over them, by metric: those of several rounds add up."""
_COUNTS = ("proposed", "arranged", "reached", "tries", "successes", "task_tries", "task_successes", "heights")


@dataclass(frozen=True, slots=True)
class GoalRecords:
    """The goal of each world in a round and its outcome; all arrays have N rows."""

    start_state: StateArray
    """(N, S) full physics state Bob started from; Alice too, unless ``replayed``."""
    start_position: StateArray
    """(N, 3 K) positions of the objects there, metres."""
    goal: StateArray
    """(N, 3 K) the goal Bob played, metres: Alice's proposal, or another where ``replayed``."""
    proposal: StateArray
    """(N, 3 K) positions at the end of Alice's turn, metres; those of its start of what she did not move."""
    verdict: NDArray[np.int8]
    """(N,) ``Verdict`` of Alice's proposal."""
    replayed: BoolArray
    """(N,) Bob played a goal of the goal source, not hers of now; one that was hers has its own ``start_state``."""
    from_reset: BoolArray
    """(N,) Bob started where a game does, as he does whenever he is evaluated."""
    played: BoolArray
    """(N,) Bob had a whole turn: there was a goal, and the physics held."""
    solved: BoolArray
    """(N,) Bob came within the success distance."""
    num_bob_steps: IntArray
    """(N,)."""
    alice_past: BoolArray
    """(N,) a past Alice proposed."""
    bob_past: BoolArray
    """(N,) a past Bob played."""
    round_index: IntArray
    """(N,) 0 for the first round after a reset."""

    @property
    def own(self) -> BoolArray:
        """(N,) Bob played the valid goal that this world's Alice had just proposed."""
        own: BoolArray = (self.verdict == Verdict.VALID) & self.played & ~self.replayed
        return own

    @property
    def current(self) -> BoolArray:
        """(N,) the current Bob played the current Alice's goal: what success statistics are about."""
        return self.own & ~self.alice_past & ~self.bob_past


def sampled_goals(records: GoalRecords) -> StateArray:
    """Valid proposals that the current Bob played, at most ``GOALS_PER_ITERATION``.

    Returns:
        (M, 6 K + 1) starts x y z, goals x y z (metres), solved 0/1.
    """
    rows = np.flatnonzero(records.own & ~records.bob_past)[:GOALS_PER_ITERATION]
    solved = records.solved[rows, None].astype(float)
    return np.concatenate([records.start_position[rows], records.goal[rows], solved], axis=1)


def of_furthest(goals: Sequence[Sequence[float]]) -> StateArray:
    """(M, 7) start, goal, solved of ``sampled_goals``: of several objects those of the one that goes furthest.

    Raises:
        ValueError: rows of other numbers.
    """
    rows = np.array(goals, dtype=np.float64).reshape(len(goals), len(goals[0]) if goals else 7)
    half = rows.shape[1] // 2
    if rows.shape[1] % 6 != 1:
        raise ValueError(f"rows of {rows.shape[1]} numbers are no goals")
    start, goal = each_object(rows[:, :half]), each_object(rows[:, half : 2 * half])
    furthest = np.arange(len(rows)), np.linalg.norm(goal - start, axis=2).argmax(axis=1)
    return np.column_stack([start[furthest], goal[furthest], rows[:, -1]])


def alice_sums(records: GoalRecords, world: WorldConfig) -> Sums:
    """Metrics of the current Alice's proposals, as sums.

    Verdict fractions are over all her proposals; lifted, heights and distance over the valid ones. The distance leaves
    out worlds whose valid goal was replaced by a replayed one: their records hold the replayed goal's start. Of several
    objects the highest and the furthest count.
    """
    verdict = records.verdict[~records.alice_past]
    valid = _valid(records)
    proposal = highest(records.proposal[valid], world)
    from_own_start = valid & ~records.replayed
    distance = distances(records.proposal[from_own_start], records.start_position[from_own_start]).max(axis=1)
    bins = height_bins(proposal, world.rest_height_m)
    cases: dict[str, Array] = {f"alice/{kind.name.lower()}_fraction": verdict == kind for kind in Verdict}
    cases["alice/lifted_fraction"] = in_air(proposal, world.rest_height_m)
    cases |= {f"alice/goal_height_{name}_fraction": bins == index for index, name in enumerate(HEIGHT_NAMES)}
    cases["alice/goal_distance_m"] = distance
    cases["alice/goal_height_m"] = proposal[:, 2]
    return sum_up(cases)


def bob_sums(records: GoalRecords, world: WorldConfig) -> Sums:
    """Metrics of the current Bob's success by kind of goal, as sums.

    No suffix, table and air: the current Alice's valid goals. ``past_alice`` and ``replayed`` stand apart;
    ``from_reset`` is whatever began where a game does, Alice's own goals of a first round among it.
    """
    current = records.current
    air = in_air(highest(records.goal, world), world.rest_height_m)
    kinds = {
        "": current,
        "_table": current & ~air,
        "_air": current & air,
        "_past_alice": records.own & records.alice_past & ~records.bob_past,
        "_from_reset": records.played & records.from_reset & ~records.bob_past,
        "_replayed": records.played & records.replayed & ~records.bob_past,
    }
    cases: dict[str, Array] = {f"bob/success_rate{suffix}": records.solved[goals] for suffix, goals in kinds.items()}
    cases["bob/steps_to_success"] = records.num_bob_steps[current & records.solved]
    return sum_up(cases)


def sum_up(cases: Mapping[str, Array]) -> Sums:
    """Number and sum of the (M,) cases of each metric."""
    return {name: (len(values), float(values.sum())) for name, values in cases.items()}


def means(sums: Sums) -> Metrics:
    """Means of metrics; one over no cases is left out."""
    return {name: total / num for name, (num, total) in sums.items() if num}


def count_heights(records: GoalRecords, world: WorldConfig) -> IntArray:
    """(H,) how many valid proposals of the current Alice there are in each ``HEIGHT_STEP_M`` above the table."""
    steps = np.floor(highest(records.proposal[_valid(records)], world)[:, 2] / HEIGHT_STEP_M).astype(np.int64)
    return np.bincount(np.clip(steps, 0, NUM_HEIGHT_STEPS - 1), minlength=NUM_HEIGHT_STEPS)


def height_p90_m(heights: IntArray) -> float:
    """The height up to which 90 % of ``count_heights`` lie, metres; not-a-number while there are none."""
    counted = np.cumsum(heights)
    if not counted[-1]:
        return float("nan")
    return float(np.searchsorted(counted, counted[-1] * 0.9) + 0.5) * HEIGHT_STEP_M


@dataclass(frozen=True, slots=True)
class GoalSummary:
    """The goals of one round or of several: sums, whose size depends on no number of worlds, and a bounded sample."""

    proposed: IntArray
    """(cells,) valid proposals, a past Alice's included."""
    arranged: IntArray
    """(arrangements,) the same; none of one object."""
    reached: IntArray
    """(cells,) steps after which an object was there, whoever played."""
    tries: IntArray
    """(cells,) tries of the current Bob, but for replays from the start of a game."""
    successes: IntArray
    """(cells,) of these tries."""
    task_tries: IntArray
    """(task bins,) tries of the current Bob."""
    task_successes: IntArray
    """(task bins,) of these tries."""
    metrics: Sums
    """``alice/*`` and ``bob/*`` metrics."""
    heights: IntArray
    """(H,) of ``count_heights``."""
    goals: Rows
    """(M,) valid ``goal`` that Bob played straight from Alice, with ``start_state`` and ``start_position``."""
    starts: Rows
    """``start_state`` and ``start_position`` of the games that began."""
    held_starts: Rows
    """The same of later rounds in which the gripper held the object."""
    shown: StateArray
    """(L, 6 K + 1) of ``sampled_goals``, for the run directory."""


def summarize(
    records: GoalRecords,
    starts: Rows,
    reached: IntArray,
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
        starts: (N,) of the round, where Alice's turns began.
        reached: (cells,) steps of the round after which an object was there.
        cells: of goals.
        tasks: bins of tasks.
        max_goals: of more new goals for the buffer, so many are drawn at random.
        max_starts: of more starts of either kind, so many are drawn at random.
        rng: source of the draw; it is left alone where all are kept.
    """
    tried: BoolArray = records.played & ~records.bob_past
    as_proposed: BoolArray = tried & ~(records.replayed & records.from_reset)
    bins = tasks.index(records.goal[tried], records.start_position[tried], records.start_state[tried])
    sums = alice_sums(records, tasks.world) | bob_sums(records, tasks.world)
    if tasks.some_blocked:
        sums |= _blocked_sums(records, tried, tasks.blocked(records.start_state))
    if tasks.world.num_objects > 1:
        sums |= _sums_by_object(records, tried, starts["start_position"], tasks)
    kept = _some(np.flatnonzero(records.own), max_goals, rng)
    begins: BoolArray = records.round_index == 0
    began = _some(np.flatnonzero(begins), max_starts, rng)
    held = _some(np.flatnonzero(~begins & tasks.held(starts["start_state"])), max_starts, rng)
    valid: BoolArray = records.verdict == Verdict.VALID
    proposal, began_at = records.proposal[valid], starts["start_position"][valid]
    arrangements = tasks.arrangements(proposal, began_at)
    cell = cells.of_moved(records.goal[as_proposed], records.start_position[as_proposed])
    return GoalSummary(
        proposed=cells.count(cells.of_moved(proposal, began_at)),
        arranged=np.bincount(arrangements, minlength=NUM_ARRANGEMENTS)[: cells.num_arrangements],
        reached=reached,
        tries=cells.count(cell),
        successes=cells.count(cell[records.solved[as_proposed]]),
        task_tries=np.bincount(bins, minlength=len(tasks)),
        task_successes=np.bincount(bins[records.solved[tried]], minlength=len(tasks)),
        metrics=sums,
        heights=count_heights(records, tasks.world),
        goals={name: getattr(records, name)[kept] for name in ("start_state", "start_position", "goal")},
        starts={name: rows[began] for name, rows in starts.items()},
        held_starts={name: rows[held] for name, rows in starts.items()},
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
        held_starts=join_rows(parts["held_starts"]),
        shown=np.concatenate(parts["shown"])[:GOALS_PER_ITERATION],
    )


def _join_sums(sums: Sequence[Sums]) -> Sums:
    return {name: (sum(each[name][0] for each in sums), sum(each[name][1] for each in sums)) for name in sums[0]}


def _blocked_sums(records: GoalRecords, tried: BoolArray, blocked: BoolArray) -> Sums:
    valid: BoolArray = records.verdict[blocked & ~records.alice_past & ~records.replayed] == Verdict.VALID
    return sum_up({"alice/valid_fraction_blocked": valid, "bob/success_rate_blocked": records.solved[tried & blocked]})


def _sums_by_object(records: GoalRecords, tried: BoolArray, began_at: StateArray, tasks: TaskBins) -> Sums:
    """Of several objects: Bob's success at whatever he tried, and Alice's valid goals, by arrangement and object."""
    valid, solved = _valid(records), records.solved[tried]
    goal, start = records.goal[tried], records.start_position[tried]
    asked, moved = tasks.arrangements(goal, start), distances(goal, start).argmax(axis=1)
    proposal = records.proposal[valid]
    shown, place = tasks.arrangements(proposal, began_at[valid]), each_object(proposal)
    cases: dict[str, Array] = {}
    for kind, name in enumerate(ARRANGEMENT_NAMES):
        cases |= {f"bob/success_rate_{name}": solved[asked == kind], f"alice/{name}_fraction": shown == kind}
    for index, rest_height_m in enumerate(tasks.world.rest_heights_m):
        cases[f"bob/success_rate_object_{index + 1}"] = solved[(asked == ONE_MOVED) & (moved == index)]
        cases[f"alice/lifted_fraction_object_{index + 1}"] = in_air(place[:, index], rest_height_m)
    return sum_up(cases)


def _some(rows: IntArray, num: int, rng: np.random.Generator) -> IntArray:
    """At most ``num`` of the rows, drawn at random, in their order."""
    return rows if len(rows) <= num else np.sort(rng.choice(rows, num, replace=False))


def _valid(records: GoalRecords) -> BoolArray:
    valid: BoolArray = (records.verdict == Verdict.VALID) & ~records.alice_past
    return valid
