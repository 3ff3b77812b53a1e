"""The table of systems in four rows."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.report.comparison import learning
from benchmarks.report.downstream import BEST
from benchmarks.report.markdown import Row, percent, table
from benchmarks.report.results import Result, by_method_and_task
from service.envs.tasks import TASKS
from service.methods.task_evaluation import Rate, rate_of
from service.methods.task_methods import METHODS

_OWN = "ours-her"
"""The composing method of the summary."""
_PAPER_SEEDS = 3
"""Of every rate of the paper, as its table says."""


def headline_table(results: Sequence[Result]) -> str:
    """Success at the last step: composing, Bob alone, and the best method of other kinds on each task.

    Every cell has its number of seeds in brackets.
    """
    rates = {place: rate_of(seeds) for place, seeds in by_method_and_task(results).items()}
    known = {method for method, _ in rates}
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
            rows.append(
                (words, *(_best([rates[name, task] for name in found if (name, task) in rates]) for task in TASKS))
            )
    rows.append(("*the best of the paper*", *(f"*{percent(rate)} ({_PAPER_SEEDS})*" for rate in BEST.values())))
    words = "Success at the last step, the mean of the seeds; in brackets how many seeds."
    return f"{table(('', *(task.title for task in TASKS.values())), rows)}\n\n{words}"


def _best(rates: Sequence[Rate]) -> str:
    best = max(rates, key=lambda rate: (rate.mean, rate.num_seeds), default=None)
    return "" if best is None else f"{percent(best.mean)} ({best.num_seeds})"
