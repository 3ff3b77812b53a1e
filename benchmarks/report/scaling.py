"""Blocks of ``docs/scaling.md`` that are measured anew, in Markdown: one box, and sizes of updates."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from benchmarks.report.markdown import commit, millions, percent, table

Result = Mapping[str, Any]
RECIPE = "recipe"
"""Name of the file of the recipe without any change, which other sizes of update are compared with."""


def box_block(result: Result) -> str:
    """One box."""
    rows = []
    for num, each in result["one_box"].items():
        spent = {role: 1e6 * cores / each["env_steps_per_s"] for role, cores in each["cores"].items()}
        rows.append(
            (num, f"{each['num_worlds']}", f"{each['env_steps_per_s']:,.0f}", f"{each['iteration_s']:.2f} s",
             percent(each["learner_idle_share"]), percent(each["actor_idle_share"]),
             f"{sum(each['cores'].values()):.2f} of {result['machine']['num_cpus']}",
             f"{sum(spent.values()):.0f} us", f"{spent['actor']:.0f} us", f"{spent['learner']:.0f} us")
        )  # fmt: skip
    head = ("actors", "worlds of each", "env steps/s", "an iteration", "learner idle", "actors idle", "cores busy",
            "CPU time of an env step", "in actors", "in the learner")  # fmt: skip
    where = result["machine"]
    words = f"{where['cpu']}, {where['num_cpus']} cores, {commit(where['git_commit'])}, {where['time'][:10]}."
    return f"{words}\n\n{table(head, rows)}"


def batches_block(studies: Mapping[str, Result]) -> str:
    """Env steps and updates until the skill, by worlds of an update; medians, a seed that was not there is infinite."""
    head = ("worlds", "recorded in", "seeds that were there", "env steps", "updates", "the recipe's, same seeds")
    rows = []
    for name, study in sorted(studies.items(), key=lambda item: item[1]["settings"]["num_worlds"]):
        seeds = {run["seed"] for run in study["runs"]}
        same = [run for run in studies[RECIPE]["runs"] if run["seed"] in seeds]
        there = f"{sum(run['reached'] for run in study['runs'])} of {len(seeds)}"
        steps, updates = _median(study["runs"], "env_steps"), _median(study["runs"], "iteration")
        numbers = _number(steps, millions), _number(updates), _number(_median(same, "iteration"))
        rows.append([str(study["settings"]["num_worlds"]), f"`{name}.json`", there, *numbers])
    return table(head, rows)


def _median(runs: Sequence[Mapping[str, Any]], key: str) -> float:
    """Median of what the skill took; a seed that was not there never is."""
    return float(statistics.median(run["at"][key] if run["reached"] else math.inf for run in runs))


def _number(value: float, write: Callable[[float], str] = "{:,.0f}".format) -> str:
    return write(value) if math.isfinite(value) else ""
