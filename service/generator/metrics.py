"""Metrics of both players from the goals of one iteration; metric names are an API."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.generator.difficulty import HEIGHT_NAMES, height_bins, in_air
from service.generator.records import GoalRecords
from service.generator.validity import Verdict
from service.types import Metrics


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
    for index, name in enumerate(HEIGHT_NAMES):
        metrics[f"alice/goal_height_{name}_fraction"] = mean(bins == index)
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


def mean(values: NDArray[np.bool_] | NDArray[np.float64] | NDArray[np.int64]) -> float:
    """Mean of (M,) values; not-a-number of none, without NumPy's warning."""
    return float(values.mean()) if len(values) else float("nan")


def without_nan(metrics: Metrics) -> Metrics:
    """Metrics that have a value."""
    return {name: value for name, value in metrics.items() if not np.isnan(value)}
