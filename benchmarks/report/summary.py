"""Few words about the whole: the table of systems in four rows, and what the controls of self-play say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.controls import OURS
from benchmarks.report.comparison import learning, trials_of
from benchmarks.report.markdown import Row, percent, table
from benchmarks.run_files import Run
from service.downstream.files import TRIAL
from service.downstream.methods import METHODS
from service.downstream.page import BEST
from service.downstream.results import Result
from service.envs.tasks import TASKS

_OWN = "ours-her"
"""The composing method of the summary."""
_NAMES = {
    "uniform": "uniform goals without her",
    "uniform-alice": "uniform goals beside hers",
    "table": "uniform goals on the table without her",
    "learnable": "goals he solves half the time without her",
    "learnable-alice": "goals he solves half the time beside hers",
}


def headline_table(results: Sequence[Result]) -> str:
    """Success at the last step: composing, Bob alone, and the best method of other kinds on each task."""
    known = {each[TRIAL]["method"] for each in results}
    groups = {
        "composing frozen primitives, with hindsight": [_OWN],
        "Bob alone, no downstream step": ["asp-only"],
        "learned from nothing": learning(None),
        "skills of other methods, without hindsight": learning("skills"),
    }
    rows: list[Row] = []
    for title, names in groups.items():
        if found := [name for name in names if name in known]:
            words = f"{title}, the best of up to {len(found)} on each task"
            if len(found) == 1:
                words = title if len(names) == 1 else f"{title}: {METHODS[found[0]].title}"
            rows.append((words, *(_best(results, found, task) for task in TASKS)))
    rows.append(("*the best of the paper*", *(f"*{percent(rate)}*" for rate in BEST.values())))
    return table(("", *(task.title for task in TASKS.values())), rows)


def controls_words(runs: Sequence[Run]) -> str:
    """One sentence: what Bob has with Alice's goals, and with others, after as many env steps of his own."""
    seeds = {name: [run for run in runs if run["control"] == name] for name in (OURS, *_NAMES)}
    others = [f"{_mixed(seeds[name])} with {words}" for name, words in _NAMES.items() if seeds[name]]
    steps = np.mean([run["bob_env_steps"] for run in seeds[OURS]]) / 1e6
    return (
        f"After {steps:.1f} million env steps of his own Bob solves {_mixed(seeds[OURS])} of random goals with those "
        f"that Alice proposes, {', '.join(others)} (mean, and in brackets the number of seeds; "
        "[all controls](docs/results/skills.md))."
    )


def _best(results: Sequence[Result], methods: Sequence[str], task: str) -> str:
    means = []
    for method in methods:
        rates = [each["evaluation"]["success_last"] for each in trials_of(results, method, task)]
        means += [float(np.mean(rates))] if rates else []
    return percent(max(means)) if means else ""


def _mixed(runs: Sequence[Run]) -> str:
    shares = [
        row["success_last"]
        for run in runs
        for row in run["evaluations"]
        if (row["policy"], row["goals"]) == ("bob", "mixed")
    ]
    return f"{percent(float(np.mean(shares)), 1)} ({len(shares)})"
