"""What came out of a study: the best run, a table with intervals over seeds, and all numbers as CSV.

The best run is named by its success on goals that are used for nothing else. What is reported of it comes from other
goals, so that having been chosen does not make it look better than it is.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.actors.evaluation import SELECTION_SEED, evaluate_run
from service.base.types import StateArray
from service.policies.numpy_policy import numpy_bob
from service.registry.loading import load
from service.runs.grid import SEED, Settings
from service.runs.study_run import StudyRun

SELECTION_EPISODES = 1000
"""A success of 95 % is then known to 1.4 points either way."""
SELECTED, DISTANCE = "selection_success_last", "selection_mean_distance_m"
"""Results on the goals that choose."""
MEASURES = ("success_last", "mixed_success_last", "table_success_last", "coverage")
"""Results that a table is of: the first that its runs have. Tasks have the first, primitives the second or, beside a
fixture, the third, and skills the last."""
NUM_RESAMPLES = 10_000


class Summary(NamedTuple):
    """Runs that differ in nothing but their seed, or some of several tasks, in a few numbers."""

    num: int
    mean: float
    iqm: float
    """Interquartile mean: of the middle half, so that a run that failed or excelled counts for little."""
    low: float
    """Lower end of the 95 % interval of the interquartile mean."""
    high: float
    """Upper end of that interval."""


def interquartile_mean(values: StateArray) -> StateArray:
    """Mean without the lowest and the highest quarter, rounded down, as ``scipy.stats.trim_mean(values, 0.25)``.

    Args:
        values: (..., N).

    Returns:
        (...).
    """
    cut = values.shape[-1] // 4
    middle: StateArray = np.sort(values, axis=-1)[..., cut : values.shape[-1] - cut].mean(axis=-1)
    return middle


def bootstrap_interval(groups: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Both ends of the 95 % percentile bootstrap interval of the interquartile mean.

    Efron 1979; of several tasks Agarwal et al. 2021.

    Args:
        groups: values of one task each; each group is resampled by itself.
    """
    rng = np.random.default_rng(0)  # the same runs have the same interval
    arrays = [np.asarray(values, dtype=np.float64) for values in groups]
    drawn = [values[rng.integers(len(values), size=(NUM_RESAMPLES, len(values)))] for values in arrays]
    low, high = np.percentile(interquartile_mean(np.concatenate(drawn, axis=1)), (2.5, 97.5))
    return float(low), float(high)


def summarise(groups: Sequence[Sequence[float]]) -> Summary:
    """A row of the table; see ``bootstrap_interval`` for the groups."""
    values = np.concatenate([np.asarray(each, dtype=np.float64) for each in groups])
    low, high = bootstrap_interval(groups)
    return Summary(len(values), float(values.mean()), float(interquartile_mean(values)), low, high)


def measure_of(runs: Iterable[StudyRun]) -> str | None:
    """The result that a table is of, of a method of a user's the first that it has; None where no run has one."""
    there = list(dict.fromkeys(name for run in runs for name in run.result))
    return next((name for name in (*MEASURES, *there) if name in there), None)


def summaries(runs: Iterable[StudyRun]) -> list[tuple[Settings, Summary]]:
    """A row for all settings but the seed; where there are several tasks, also one for all tasks together."""
    runs = list(runs)
    measure = measure_of(runs)
    groups: dict[tuple[tuple[str, str], ...], list[float]] = {}
    for run in runs:
        if measure in run.result:
            key = tuple((name, value) for name, value in run.settings.items() if name != SEED)
            groups.setdefault(key, []).append(run.result[measure])
    rows = [(dict(key), summarise([values])) for key, values in groups.items()]
    over: dict[tuple[tuple[str, str], ...], list[list[float]]] = {}
    for key, values in groups.items():
        over.setdefault(tuple((name, "all" if name == "task" else value) for name, value in key), []).append(values)
    return rows + [(dict(key), summarise(tasks)) for key, tasks in over.items() if len(tasks) > 1]


def as_csv(runs: Mapping[str, StudyRun]) -> str:
    """A line for each run, with its settings and results; empty where it has none."""
    settings = list(dict.fromkeys(key for run in runs.values() for key in run.settings))
    results = list(dict.fromkeys(key for run in runs.values() for key in run.result))
    file = io.StringIO()
    columns = ["run", *settings, "state", "env_steps", "wall_s", *results]
    writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
    writer.writeheader()
    for name, run in runs.items():
        own = {"run": name, "state": run.state, "env_steps": run.env_steps, "wall_s": round(run.wall_s, 1)}
        writer.writerow({**run.settings, **run.result, **own})
    return file.getvalue()


def select(directory: Path) -> dict[str, float]:
    """Evaluate the Bob of a run's newest checkpoint on the goals that choose.

    Raises:
        TandemError: the run has no usable checkpoint.
    """
    trained = load(str(directory))
    bob, goals = numpy_bob(trained.parameters), trained.config.world.usual_goals
    found = evaluate_run(bob, trained.config, goals, SELECTION_EPISODES, seed=SELECTION_SEED)
    return {SELECTED: found.success_last, DISTANCE: found.mean_distance_m}


def best_of(runs: Mapping[str, StudyRun]) -> str | None:
    """The run with the highest success on the goals that choose; of equals, whose object ends nearer to the goals."""
    scores = {name: run.result for name, run in runs.items() if run.has_ended and SELECTED in run.result}
    return max(scores, key=lambda name: (scores[name][SELECTED], -scores[name][DISTANCE]), default=None)


def published_metrics(run: StudyRun, goals: str) -> dict[str, float]:
    """What a version says of the best run: what was measured at its end, and its success on the goals that chose it.

    Args:
        run: the best one.
        goals: kind of those that chose it.
    """
    metrics = {f"evaluation/{name}": value for name, value in run.result.items() if not name.startswith("selection_")}
    return metrics | {f"selection/{goals}_success_last": run.result[SELECTED], "env_steps": run.env_steps}
