"""The table of systems in four rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.report.comparison import learning, trials_of
from benchmarks.report.markdown import Row, percent, table
from service.downstream.files import TRIAL
from service.downstream.methods import METHODS
from service.downstream.page import BEST
from service.downstream.results import Result
from service.envs.tasks import TASKS

_OWN = "ours-her"
"""The composing method of the summary."""
_PAPER_SEEDS = 3
"""Of every rate of the paper, as its table says."""


def headline_table(results: Sequence[Result]) -> str:
    """Success at the last step: composing, Bob alone, and the best method of other kinds on each task.

    Every cell has its number of seeds in brackets.
    """
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
    rows.append(("*the best of the paper*", *(f"*{percent(rate)} ({_PAPER_SEEDS})*" for rate in BEST.values())))
    words = "Success at the last step, the mean of the seeds; in brackets how many seeds."
    return f"{table(('', *(task.title for task in TASKS.values())), rows)}\n\n{words}"


def _best(results: Sequence[Result], methods: Sequence[str], task: str) -> str:
    means = []
    for method in methods:
        rates = [each["evaluation"]["success_last"] for each in trials_of(results, method, task)]
        means += [(float(np.mean(rates)), len(rates))] if rates else []
    if not means:
        return ""
    best, num_seeds = max(means)
    return f"{percent(best)} ({num_seeds})"
