"""Records of the goals of a round, and both players' metrics from them; metric names are an API."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from service.generator.difficulty import HEIGHT_NAMES, height_bins, in_air
from service.generator.validity import Verdict
from service.types import Array, BoolArray, IntArray, Metrics, StateArray

GOALS_PER_ITERATION = 32
"""Number of valid proposals kept for the run directory per iteration, at most."""


@dataclass(frozen=True, slots=True)
class GoalRecords:
    """The goal of each world in a round and its outcome; all arrays have N rows."""

    start_state: StateArray
    """(N, S) full physics state Bob started from; Alice too, unless ``replayed``."""
    start_position: StateArray
    """(N, 3) object position there, metres."""
    goal: StateArray
    """(N, 3) the goal Bob played, metres: Alice's proposal, or a replayed goal where ``replayed``."""
    proposal: StateArray
    """(N, 3) object position at the end of Alice's turn, metres."""
    verdict: NDArray[np.int8]
    """(N,) ``Verdict`` of Alice's proposal."""
    replayed: BoolArray
    """(N,) Bob played a goal from the replay buffer (``start_state`` is then that goal's own)."""
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


def join_records(records: Sequence[GoalRecords]) -> GoalRecords:
    """Join the records of several rounds into one of all their worlds."""
    names = [field.name for field in fields(GoalRecords)]
    return GoalRecords(**{name: np.concatenate([getattr(each, name) for each in records]) for name in names})


def sampled_goals(records: GoalRecords) -> StateArray:
    """Valid proposals that the current Bob played, at most ``GOALS_PER_ITERATION``.

    Returns:
        (M, 7) start x y z, goal x y z (metres), solved 0/1.
    """
    rows = np.flatnonzero(records.own & ~records.bob_past)[:GOALS_PER_ITERATION]
    solved = records.solved[rows, None].astype(float)
    return np.concatenate([records.start_position[rows], records.goal[rows], solved], axis=1)


def alice_metrics(records: GoalRecords, rest_height_m: float) -> Metrics:
    """The current Alice's proposals; a mean over no cases is left out.

    Verdict fractions are over all her proposals; lifted, heights and distance over the valid ones. The distance leaves
    out worlds whose valid goal was replaced by a replayed one: their records hold the replayed goal's start.
    """
    verdict = records.verdict[~records.alice_past]
    valid = (records.verdict == Verdict.VALID) & ~records.alice_past
    proposal = records.proposal[valid]
    from_own_start = valid & ~records.replayed
    distance = np.linalg.norm((records.proposal - records.start_position)[from_own_start], axis=-1)
    metrics = {f"alice/{kind.name.lower()}_fraction": mean(verdict == kind) for kind in Verdict}
    metrics["alice/lifted_fraction"] = mean(in_air(proposal, rest_height_m))
    bins = height_bins(proposal, rest_height_m)
    metrics |= {f"alice/goal_height_{name}_fraction": mean(bins == index) for index, name in enumerate(HEIGHT_NAMES)}
    metrics["alice/goal_distance_m"] = mean(distance)
    metrics["alice/goal_height_m"] = mean(proposal[:, 2])
    metrics["alice/goal_height_p90_m"] = float(np.percentile(proposal[:, 2], 90)) if len(proposal) else float("nan")
    return without_nan(metrics)


def bob_metrics(records: GoalRecords, rest_height_m: float) -> Metrics:
    """The current Bob's success by kind of goal; a mean over no cases is left out.

    No suffix, table and air: the current Alice's valid goals. ``past_alice`` and ``replayed`` stand apart.
    """
    current = records.current
    air = in_air(records.goal, rest_height_m)
    kinds = {
        "": current,
        "_table": current & ~air,
        "_air": current & air,
        "_past_alice": records.own & records.alice_past & ~records.bob_past,
        "_from_reset": records.played & records.from_reset & ~records.bob_past,
        "_replayed": records.played & records.replayed & ~records.bob_past,
    }
    metrics = {f"bob/success_rate{suffix}": mean(records.solved[goals]) for suffix, goals in kinds.items()}
    metrics["bob/steps_to_success"] = mean(records.num_bob_steps[current & records.solved])
    return without_nan(metrics)


def mean(values: Array) -> float:
    """Mean of (M,) values; not-a-number of none, without NumPy's warning."""
    return float(values.mean()) if len(values) else float("nan")


def without_nan(metrics: Metrics) -> Metrics:
    """Metrics that have a value."""
    return {name: value for name, value in metrics.items() if not np.isnan(value)}
