"""Success rates beside the paper's: the tables of ``docs/results/comparison.md``, and systems in four rows."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

from benchmarks.report.downstream import BEST, PAPER, Seeds, each_seed, mean_until
from benchmarks.report.markdown import Row, from_to, millions, percent
from benchmarks.report.results import TRIAL, Result, by_method_and_task
from benchmarks.reproduce import MANY_UPDATES, PAPER_PRIMITIVES, Experiment
from service.base.intervals import Rate, rate_of, wilson_interval
from service.base.markdown import table
from service.config.task_methods import TASK_METHODS
from service.envs.tasks import PAPERS, find_task

PAPER_EPISODES = 48
"""Of each of the paper's rates, most likely: nearly all are multiples of 1/48, so 16 episodes of three seeds."""
GOOD = 0.9
"""Success of which longer trials say when they reach it."""
_PAPER_RECIPE = next(iter(PAPER_PRIMITIVES.values())).partition("@")[0]
OWN = "ours-her"
"""The composing method of the summary."""
OWN_ALONE = "ours"
"""The same without hindsight, as the paper has it."""
_PAPER_SEEDS = 3
"""Of every rate of the paper, as its table says."""


def comparison_table(results: Sequence[Result], as_paper: Sequence[Result] = ()) -> str:
    """Every method of the paper, every task: our mean of the seeds, and in brackets the paper's and the difference.

    ``as_paper`` are trials with primitives of the recipe ``panda-cube-paper``; their methods have rows of their own.

    The last column has our seeds: their number on every task, or the least and the greatest of the tasks that were run.

    Bold where it is no accident: the paper's interval, Wilson's of 48 episodes, and ours have nothing in common.
    """
    of, of_paper = by_method_and_task(results), by_method_and_task(as_paper)
    rows = [_compared(TASK_METHODS[method].title, method, of) for method in PAPER]
    trained = [method for method in PAPER if any(name == method for name, _ in of_paper)]
    rows += [_compared(f"{TASK_METHODS[method].title}, `{_PAPER_RECIPE}`", method, of_paper) for method in trained]
    return table(("", *(find_task(task).title for task in PAPERS), "our seeds"), rows)


def longer_table(results: Sequence[Result], longer: Sequence[Result], more_updates: Sequence[Result] = ()) -> str:
    """Success after the env steps of the table and after those of longer trials, where there are such, of equal seeds.

    Where each of these seeds was ``GOOD``, by the mean of two evaluations in a row, the cell says from when on.
    ``more_updates`` are longer trials with ``MANY_UPDATES`` of the learner for every 64 env steps; the table has none.
    """
    tasks = [task for task in PAPERS if any(each[TRIAL]["task"] == task for each in (*longer, *more_updates))]
    of, of_longer, of_many = (by_method_and_task(trials) for trials in (results, longer, more_updates))
    with_many, rows = f", {MANY_UPDATES} updates for 64 env steps", list[Row]()
    for words, trials in (("", of_longer), (with_many, of_many)):
        for method in TASK_METHODS:
            places = [(method, task) for task in tasks]
            if any(place in trials for place in places):
                cells = (
                    _after(trials.get(place, []), of.get(place, []) if trials is of_longer else None)
                    for place in places
                )
                rows.append((TASK_METHODS[method].title + words, *cells))
    return table(("", *(find_task(task).title for task in tasks)), rows)


def harder_table(results: Sequence[Result]) -> str:
    """Success at the last step on *HardPush* and, of the same seeds, on *Push*: each seed."""
    of = by_method_and_task(results)
    rows: list[Row] = []
    for method in TASK_METHODS:
        hard, plain = (
            {each[TRIAL]["seed"]: each for each in of.get((method, task), [])} for task in ("hard-push", "push")
        )
        if hard:
            rows.append(
                (TASK_METHODS[method].title, each_seed(hard.values()), each_seed(plain[s] for s in hard if s in plain))
            )
    return table(("", "HardPush", "Push, the same seeds"), rows) if rows else ""


def missing_table(planned: Sequence[Experiment]) -> str:
    """How many of the planned experiments have their file, and which lack it, with hours, in the plan's order."""
    groups = defaultdict[str, list[Experiment]](list)
    for experiment in planned:
        groups[experiment.group].append(experiment)
    done = {title: sum(each.file.exists() for each in group) for title, group in groups.items()}
    rows = [
        (title, f"{done[title]} of {len(group)}", _missing(group), f"{_hours(group):.1f}")
        for title, group in groups.items()
        if done[title] < len(group)
    ]
    words = f"{sum(done.values())} of {len(planned)} experiments are recorded."
    left = f"By the plan the others take {_hours(planned):.0f} hours of one core."
    heads = ("", "recorded", "missing", "hours of one core")
    return f"{words} {left} Missing:\n\n{table(heads, rows)}" if rows else words


def _hours(group: Sequence[Experiment]) -> float:
    """Of one core, of those that lack their file."""
    return sum(each.hours for each in group if not each.file.exists())


def _missing(group: Sequence[Experiment]) -> str:
    """Parts that lack their file, those with the same seeds together."""
    seeds = defaultdict[str, list[str]](list)
    for each in group:
        if not each.file.exists():
            seeds[each.part].append(str(each.seed))
    parts = defaultdict[str, list[str]](list)
    for part, numbers in seeds.items():
        parts[", ".join(numbers)].append(part)
    num = len({each.part for each in group})
    return "; ".join(
        f"{'all' if len(names) == num else ', '.join(names)}: {'seeds' if ',' in numbers else 'seed'} {numbers}"
        for numbers, names in parts.items()
    )


def _after(after: Seeds, before: Seeds | None) -> str:
    """Success after, and what it was before, of equal seeds; None: it says nothing of before."""
    begun = ""
    if before is not None:
        seeds = {each[TRIAL]["seed"] for each in after}
        alike = [each for each in before if each[TRIAL]["seed"] in seeds]
        if alike:
            known = {each[TRIAL]["seed"] for each in alike}
            after = [each for each in after if each[TRIAL]["seed"] in known]
        begun = f"{_mean(alike)} to "
    if not after:
        return ""
    good = mean_until(after, GOOD)
    when = "" if good is None else f", {percent(GOOD)} after {millions(good)}"
    return f"{begun}{_mean(after)} ({len(after)}){when}"


def _compared(title: str, method: str, of: Mapping[tuple[str, str], list[Result]]) -> Row:
    """A method's row beside the paper's rates."""
    found = [of.get((method, task), []) for task in PAPERS]
    cells = [_cell(seeds, PAPER[method][task]) for seeds, task in zip(found, PAPERS, strict=True)]
    counts = [len(seeds) for seeds in found if seeds]
    return title, *cells, from_to(counts) if counts else "0"


def _mean(seeds: Seeds) -> str:
    return f"{100 * rate_of(seeds).mean:.1f}" if seeds else "not run"


def learning(takes: str | None) -> list[str]:
    """Names of the methods that learn downstream with what they take, ``"skills"`` for one; None: from nothing."""
    return [name for name, method in TASK_METHODS.items() if method.takes == takes and method.learns]


def _cell(seeds: Seeds, paper: float) -> str:
    if not seeds:
        return f"not run ({100 * paper:.0f})"
    ours = rate_of(seeds)
    low, high = wilson_interval(round(paper * PAPER_EPISODES), PAPER_EPISODES)
    text = f"{100 * ours.mean:.1f} ({100 * paper:.0f}, {100 * (ours.mean - paper):+.0f})"
    return f"**{text}**" if ours.low > high or ours.high < low else text


def headline_table(results: Sequence[Result]) -> str:
    """Success at the last step: composing, Bob alone, and the best method of other kinds on each task.

    Every cell has its number of seeds in brackets. A kind that was not measured on every task is left out.
    """
    rates = {place: rate_of(seeds) for place, seeds in by_method_and_task(results).items()}
    known = {method for method, _ in rates}
    groups = {
        "composing frozen primitives, with hindsight": [OWN],
        "Bob alone, no downstream step": ["asp-only"],
        "learned from nothing": learning(None),
        "skills of other methods, without hindsight": learning("skills"),
    }
    rows: list[Row] = []
    for title, names in groups.items():
        found = [name for name in names if name in known]
        if all(any((name, task) in rates for name in found) for task in PAPERS):
            words = f"{title}, the best of up to {len(found)} methods on each task"
            if len(found) == 1:
                words = title if len(names) == 1 else f"{title}: {TASK_METHODS[found[0]].title}"
            rows.append(
                (words, *(_best([rates[name, task] for name in found if (name, task) in rates]) for task in PAPERS))
            )
    rows.append(("*the best of the paper*", *(f"*{percent(rate)} ({_PAPER_SEEDS})*" for rate in BEST.values())))
    words = f"Success at the last step, mean of the seeds; in brackets their number.{_without_hindsight(rates)}"
    return f"{table(('', *(find_task(task).title for task in PAPERS)), rows)}\n\n{words}"


def _without_hindsight(rates: Mapping[tuple[str, str], Rate]) -> str:
    """A sentence on composing without hindsight, where every task has it: the task that differs most, and the rest."""
    if not all((name, task) in rates for name in (OWN, OWN_ALONE) for task in PAPERS):
        return ""
    gaps = {task: abs(rates[OWN, task].mean - rates[OWN_ALONE, task].mean) for task in PAPERS}
    most, *others = sorted(PAPERS, key=lambda task: -gaps[task])
    there, points = percent(rates[OWN_ALONE, most].mean), f"{100 * gaps[others[0]]:.1f}"
    where = find_task(most).title
    return f" Composing without hindsight: {there} on *{where}*; on others it differs by {points} points at most."


def _best(rates: Sequence[Rate]) -> str:
    best = max(rates, key=lambda rate: (rate.mean, rate.num_seeds), default=None)
    return "" if best is None else f"{percent(best.mean)} ({best.num_seeds})"
