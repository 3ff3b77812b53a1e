"""Sentences below the summary of the six tasks, for the README and ``docs/downstream.md``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.report.comparison import GOOD, learning
from benchmarks.report.downstream import Seeds, mean_until
from benchmarks.report.markdown import from_to, millions, percent
from benchmarks.report.results import Result, by_method_and_task
from benchmarks.reproduce import MANY_UPDATES
from service.base.intervals import rate_of
from service.base.types import FloatArray
from service.config.task_methods import TASK_METHODS
from service.envs.tasks import PAPERS, find_task

LEVEL = 0.05
"""Two means that differ by less are level: single points of a curve scatter by about as much."""


def ahead_words(results: Sequence[Result], composing: str, task: str) -> str:
    """When composing is last ahead of the best that learns from nothing, and what is between them at the end."""
    of = by_method_and_task(results)
    rivals = [of[name, task] for name in learning(None) if (name, task) in of]
    if not rivals or (composing, task) not in of:
        return ""
    steps = [point["env_steps"] for point in of[composing, task][0]["curve"]]
    own, best = _means(of[composing, task], steps), np.max([_means(seeds, steps) for seeds in rivals], axis=0)
    ahead = np.flatnonzero(own - best >= LEVEL)
    last = round(100 * (rate_of(of[composing, task]).mean - max(rate_of(seeds).mean for seeds in rivals)))
    points = f"{abs(last)} point{'s' * (abs(last) > 1)}"
    end = f"it is {points} {'ahead' if last > 0 else 'behind'}" if last else "they are level"
    most, where = f"{100 * LEVEL:.0f} points or more", find_task(task).title
    if not len(ahead):
        return f"On *{where}* composing is never {most} ahead of learning from nothing; at the end {end}."
    when = f"at {round(steps[ahead[-1]], -3):,} env steps"
    return f"On *{where}* composing is last ahead of learning from nothing by {most} {when}. At the end {end}."


def longer_words(longer: Sequence[Result], more_updates: Sequence[Result]) -> str:
    """Where and when learning from nothing becomes good in longer trials, and with more updates: a line for each."""
    words = list[str]()
    for updates, trials in ((8, longer), (MANY_UPDATES, more_updates)):
        if places := _good_places(trials, f"{updates} updates for 64 env steps"):
            words.append(places)
    if not words:
        return ""
    most, said = max(each["env_steps"] for each in (*longer, *more_updates)), ";\n".join(words)
    return f"In trials of {millions(most)} env steps learning from nothing reaches {percent(GOOD)}: {said}."


def without_hindsight_words(results: Sequence[Result]) -> str:
    """How far learning from nothing without hindsight is above doing nothing, at most."""
    of = by_method_and_task(results)
    without = [name for name in learning(None) if TASK_METHODS[name].her_ratio is None]
    tasks = [task for task in PAPERS if ("idle", task) in of]
    pairs = [(of[name, task], of["idle", task]) for task in tasks for name in without if (name, task) in of]
    if not pairs:
        return ""
    most = max(rate_of(seeds).mean - rate_of(idle).mean for seeds, idle in pairs)
    return (
        f"Without hindsight learning from nothing is at most {100 * most:.1f} points above doing nothing "
        f"{_seeds_words([seeds for seeds, _ in pairs])}."
    )


def _good_places(trials: Sequence[Result], updates: str) -> str:
    """Such as ``with MCP and UPDATES, *InAir* after 0.5 M (1 seed)``: of the first method that gets there."""
    of = by_method_and_task(trials)
    places = {"with MCP and": list[str](), "without MCP, with": list[str]()}
    for task in PAPERS:
        found = {name: mean_until(of[name, task], GOOD) for name in learning(None) if (name, task) in of}
        soon = {name: steps for name, steps in found.items() if steps is not None}
        if soon:
            first = min(soon, key=lambda name: soon[name])
            network = "with MCP and" if TASK_METHODS[first].mcp_actor else "without MCP, with"
            places[network].append(f"*{find_task(task).title}* after {millions(soon[first])}")
    words = "; ".join(f"{network} {updates}, {', '.join(each)}" for network, each in places.items() if each)
    return f"{words} {_seeds_words(list(of.values()))}" if words else ""


def _means(seeds: Seeds, steps: Sequence[int]) -> FloatArray:
    """Success at these env steps, mean of the seeds."""
    curves = [{point["env_steps"]: point["success_last"] for point in each["curve"]} for each in seeds]
    return np.array([np.mean([curve[step] for curve in curves]) for step in steps], dtype=np.float32)


def _seeds_words(places: Sequence[Seeds]) -> str:
    """Such as ``(1 seed)``, or ``(1 to 3 seeds)`` where these methods and tasks had unequal numbers."""
    counts = from_to([len(seeds) for seeds in places])
    return f"({counts} {'seed' if counts == '1' else 'seeds'})"
