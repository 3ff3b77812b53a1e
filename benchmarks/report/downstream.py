"""``docs/results/downstream.md``: tables from the recorded trials, beside the paper's figures, and learning curves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.report.markdown import Row
from benchmarks.report.results import TRIAL, Result, by_method_and_task
from benchmarks.run_files import steps_until
from service.base.errors import TandemError
from service.base.files import write_atomic
from service.base.intervals import rate_of
from service.base.markdown import table
from service.base.version import LEARNING_VERSION
from service.config.task_methods import TASK_METHODS
from service.envs.tasks import PAPERS, TASKS, find_task
from service.media.figures import BLUE, FAINT, GREEN, ORANGE, new_figure, save, style_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

PAGE_FILE, PICTURE_FILE = "downstream.md", "downstream.png"
_COLOURS = (BLUE, "#56B4E9", "#7B3FBF", "#000000", GREEN, ORANGE, "#CC79A7", "#E69F00", "#999999")
_LEGEND_COLUMNS = 6
Seeds = Sequence[Result]
"""Results of one method on one task."""

FINAL_SHARE = 0.9
"""Share of a method's own final success; compared is how soon it is reached."""

PAPER: Mapping[str, Mapping[str, float]] = {
    method: dict(zip(("larger", "inair", "push", "sphere", "wall", "box"), rates, strict=True))
    for method, rates in {
        "ours": (0.83, 1.00, 0.52, 1.00, 0.98, 0.98),
        "lsd": (0.17, 0.17, 0.17, 0.10, 0.04, 0.73),
        "dads": (0.06, 0.04, 0.06, 0.15, 0.56, 0.06),
        "diayn": (0.00, 0.00, 0.06, 0.02, 0.00, 0.02),
        "asp-only": (0.94, 0.94, 0.02, 0.85, 0.00, 0.27),
        "scratch-monolithic-her": (0.58, 0.94, 0.85, 1.00, 0.00, 0.36),
        "scratch-mcp-her": (0.85, 0.52, 0.92, 0.98, 0.00, 0.00),
        "scratch-monolithic": (0.02, 0.00, 0.00, 0.00, 0.00, 0.00),
        "scratch-mcp": (0.00, 0.00, 0.04, 0.00, 0.02, 0.00),
    }.items()
}
"""The paper's success rates (its table of downstream success rates; 16 episodes x 3 seeds, likely)."""

BEST: Mapping[str, float] = {task: max(rates[task] for rates in PAPER.values()) for task in PAPER["ours"]}
"""The best of all the paper's methods, skill discovery included."""


def write_results(out: Path, trials: Sequence[Result]) -> list[Path]:
    """Write page and picture."""
    page, picture = out / PAGE_FILE, draw_table(trials, out / PICTURE_FILE)
    write_atomic(page, write_page(trials).encode())
    return [page, picture]


def write_page(results: Sequence[Result]) -> str:
    """The whole page."""
    check_versions(results)
    of = by_method_and_task(results)
    parts = [
        "# Downstream\n\nWritten by `python -m benchmarks.report` from the files in "
        f"`v{LEARNING_VERSION}/downstream/`, one for each trial, a method on a task with a seed;\n"
        "[what the tasks and methods are](../downstream.md).\n",
        "## Success at the last step\n",
        "Mean of the seeds; in brackets their number. The interval is one of 95 % for the mean over seeds (Student's "
        "t). A single seed has Wilson's over its episodes instead, marked by a star: it says how far the share may be "
        "off because episodes were few, not how far another seed would differ. Below the paper's methods, its figures: "
        "they are of another world, likely a harder one "
        "([cell by cell](comparison.md), and what differs). Tasks and methods may have had different numbers of env "
        "steps: they are below.\n",
        methods_table(of, _rate("success_last"), paper=True),
        "\n## Success at any step\n",
        methods_table(of, _rate("success_ever")),
        "\n## Each seed, at the last step\n",
        methods_table(of, each_seed),
        "\n## Learning curves\n",
        f"![Success at the last step over env steps; bands from the least to the greatest seed]({PICTURE_FILE})\n",
        "Without noise, 100 goals a point; dotted: what learns nothing. Where a curve still rises, the tables say what "
        "the method has after so many env steps, not what it would come to.\n",
        "## Env steps and time\n",
        "Env steps in thousands, minutes of wall-clock time, with the evaluations on the way. Before the plus sign "
        "what the primitives or skills took, in millions of env steps: all tasks have the same. Minutes do not compare "
        "methods: the machines were of two kinds, and did other work beside the trials.\n",
        methods_table(of, _cost),
        *_efficiency(of),
        *_harder(of),
        "\n" + _origin(results),
    ]
    return "\n".join(parts)


def _harder(of: Mapping[tuple[str, str], Seeds]) -> Sequence[str]:
    """The section on harder tasks."""
    tasks = [name for name in TASKS[len(PAPERS) :] if any(task == name for _, task in of)]
    if not tasks:
        return ()
    return (
        "\n## A harder start and cube\n",
        "The end effector starts 20 cm above the table instead of 8, and the cube has 1 kg instead of 0.1 and half the "
        "grip ([decision 7](../decisions/0007-the-downstream-tasks.md)). At the last step, each seed, and at any "
        "step:\n",
        methods_table(of, _rate("success_last"), tasks=tasks),
        methods_table(of, each_seed, tasks=tasks),
        methods_table(of, _rate("success_ever"), tasks=tasks),
        "Env steps and time:\n",
        methods_table(of, _cost, tasks=tasks),
    )


def check_versions(results: Sequence[Result]) -> None:
    """Refuse results of other versions of the tasks than today's, and of two versions of what learns."""
    of = {result["made"].get("learning_version", 1): result[TRIAL] for result in results}
    if len(of) > 1:
        (one, first), (two, second), *_ = sorted(of.items())
        raise TandemError(
            f"{first['method']} on {first['task']} was recorded with version {one} of what learns, {second['method']} "
            f"on {second['task']} with version {two}: they belong into two tables; reproduce one of them"
        )
    for trial in (result[TRIAL] for result in results):
        if trial.get("task_version", 0) != find_task(trial["task"]).version:
            raise TandemError(
                f"{trial['method']} on {trial['task']} was recorded with another version of it: reproduce it"
            )


def methods_table(
    of: Mapping[tuple[str, str], Seeds],
    text: Callable[[Seeds], str],
    *,
    tasks: Sequence[str] = PAPERS,
    paper: bool = False,
) -> str:
    """A row per method that has a result, and a text per task; below it, if asked for, the paper's."""
    rows: list[Row] = []
    for method, described in TASK_METHODS.items():
        found = [of.get((method, task), []) for task in tasks]
        if any(found):
            rows.append((described.title, *(text(seeds) if seeds else "" for seeds in found)))
            if paper and method in PAPER:
                rows.append(_paper_row("*the paper's*", PAPER[method]))
    if paper:
        rows.append(_paper_row("*best of the paper*", BEST))
    return _markdown(rows, tasks)


def _paper_row(title: str, rates: Mapping[str, float]) -> Sequence[str]:
    return title, *(f"*{100 * rates[task]:.0f} %*" for task in PAPERS)


def _markdown(rows: Sequence[Row], tasks: Iterable[str] = PAPERS) -> str:
    return table(("", *(find_task(name).title for name in tasks)), rows) + "\n"


def _rate(key: str) -> Callable[[Seeds], str]:
    """Mean rates with their intervals, such as ``97.0 % [96, 98] (3)``."""
    return lambda seeds: str(rate_of(seeds, key)).replace("*", "\\*")


def each_seed(seeds: Iterable[Result]) -> str:
    """Success of each at the last step."""
    return ", ".join(f"{100 * result['evaluation']['success_last']:.1f}" for result in seeds)


def _cost(seeds: Seeds) -> str:
    before = [(result["primitives"] or {}).get("env_steps") for result in seeds]
    known = [each for each in before if each is not None]
    text = f"{np.mean(known) / 1e6:.1f} M + " if known else ""
    if not seeds[0]["curve"]:
        return f"{text}0"
    steps, minutes = (float(np.mean([result[key] for result in seeds])) for key in ("env_steps", "wall_s"))
    return f"{text}{steps / 1e3:.0f}, {minutes / 60:.0f} min"


def _efficiency(of: Mapping[tuple[str, str], Seeds]) -> Sequence[str]:
    """The section on how soon methods that compose are good, and the first that learns from nothing is as good."""
    known = {name: method for name, method in TASK_METHODS.items() if any(found == name for found, _ in of)}
    composing = [name for name, method in known.items() if method.composes]
    scratch = [name for name, method in known.items() if method.learns and method.takes is None]
    rows = []
    for method in composing:
        own, others = [TASK_METHODS[method].title], ["*best from scratch*"]
        for task in PAPERS:
            seeds = of.get((method, task), [])
            level = FINAL_SHARE * float(np.mean([each["evaluation"]["success_last"] for each in seeds] or [0.0]))
            until = mean_until(seeds, level)
            rivals = {name: of[name, task] for name in scratch if (name, task) in of}
            own.append("" if until is None else f"{until / 1e3:.0f}")
            others.append("" if until is None or not rivals else f"*{_soonest(rivals, level)}*")
        rows += [own, others]
    return (
        "\n## How soon\n",
        f"Thousands of env steps until a method reaches {FINAL_SHARE:.0%} of its own final success, as the mean of two "
        "evaluations in a row, mean of the seeds; empty where not every seed gets there. Below each, in italics: until "
        "the first method that learns from nothing comes to the same success, with all of its seeds; `>` where none "
        "does. In brackets: how many such methods were run.\n",
        _markdown(rows),
    )


def mean_until(seeds: Seeds, level: float) -> float | None:
    """Env steps until a level, mean of the seeds; None: not every seed reaches it."""
    soon = [steps_until(result["curve"], "success_last", level, num_in_a_row=2) for result in seeds]
    return None if not soon or None in soon or not level else float(np.mean(soon))  # type: ignore[arg-type]


def _soonest(of: Mapping[str, Seeds], level: float) -> str:
    """``128, scratch monolithic + HER (4)``, or ``> 200 (4)`` where no method reaches the level."""
    found = {name: mean_until(seeds, level) for name, seeds in of.items()}
    reached = {name: until for name, until in found.items() if until is not None}
    if not reached:
        longest = max(result["env_steps"] for seeds in of.values() for result in seeds)
        return f"> {longest / 1e3:.0f} ({len(of)})"
    first = min(reached, key=lambda name: reached[name])
    return f"{reached[first] / 1e3:.0f}, {TASK_METHODS[first].title} ({len(of)})"


def _origin(results: Sequence[Result]) -> str:
    taken = [each["primitives"] for each in results if each["primitives"]]
    primitives = sorted({f"{each['name']} ({each['digest'][:12]})" for each in taken})
    made = [each["made"]["git_commit"].partition("-dirty") for each in results if each["made"]["git_commit"]]
    commits = sorted({name[:12] + dirty for name, dirty, _ in made})
    return f"Primitives: {', '.join(primitives) or 'none'}. Commits: {', '.join(commits) or 'unknown'}.\n"


def draw_table(results: Sequence[Result], path: Path) -> Path:
    """Draw success at the last step over env steps: a panel per task that was run, a line per method.

    Several seeds have a band from the least to the greatest.
    """
    of, lines = by_method_and_task(results), dict[str, "Line2D"]()
    run = {task for _, task in of}
    tasks = [name for name in TASKS if name in run]
    rows = max(1, math.ceil(len(tasks) / 3))
    legend_rows = max(1, math.ceil(len({method for method, _ in of}) / _LEGEND_COLUMNS))
    above_inch = 1.15 + 0.22 * legend_rows
    height_inch = above_inch + 0.5 + 3.1 * rows
    figure = new_figure(14.0, height_inch, "Success at the last step, over thousands of env steps")
    longest = max((each["env_steps"] for each in results), default=0) / 1e3
    styles = _line_styles()
    panels = list(figure.subplots(rows, 3).flat)
    for axes in panels[len(tasks) :]:
        axes.set_axis_off()
    for axes, name in zip(panels, tasks, strict=False):
        for method, described in TASK_METHODS.items():
            if (method, name) in of:
                lines[described.title] = _draw_method(axes, of[method, name], *styles[method])
        style_axes(axes)
        axes.set_title(find_task(name).title, loc="left", fontsize=11)
        axes.set_xlabel("env steps, thousands", color=FAINT, fontsize=9)
        axes.set_ylim(-0.02, 1.02)
        axes.set_xlim(0.0, 1.02 * longest or 1.0)
    titles = [described.title for described in TASK_METHODS.values() if described.title in lines]
    anchor = (0.015, 1 - 0.65 / height_inch)  # under the title
    figure.legend(
        [lines[title] for title in titles],
        titles,
        loc="upper left",
        bbox_to_anchor=anchor,
        ncols=_LEGEND_COLUMNS,
        fontsize=9,
        frameon=False,
    )
    figure.subplots_adjust(
        left=0.05, right=0.98, top=1 - above_inch / height_inch, bottom=0.5 / height_inch, hspace=0.3
    )
    return save(figure, path)


def _line_styles() -> dict[str, tuple[str, str]]:
    """Colour and dashes of each method: those with skills have dashes, and the colours again."""
    drawn = [name for name, method in TASK_METHODS.items() if method.takes != "skills"]
    dashed = [name for name in TASK_METHODS if name not in drawn]
    return {
        name: (colour, style)
        for names, style in ((drawn, "-"), (dashed, "--"))
        for name, colour in zip(names, _COLOURS, strict=False)
    }


def _draw_method(axes: Axes, results: Seeds, colour: str, style: str) -> Line2D:
    """Mean line of several seeds and their range; a level for a method that learns nothing. Returns the line."""
    curves = [result["curve"] for result in results]
    if not all(curves):
        level = float(np.mean([result["evaluation"]["success_last"] for result in results]))
        return axes.axhline(level, color=colour, linewidth=1.0, linestyle=":")
    num = min(len(curve) for curve in curves)
    steps = np.array([point["env_steps"] for point in curves[0][:num]]) / 1e3
    values = np.array([[point["success_last"] for point in curve[:num]] for curve in curves])
    (line,) = axes.plot(steps, values.mean(0), color=colour, linestyle=style, linewidth=1.6)
    if len(curves) > 1:
        axes.fill_between(steps, values.min(0), values.max(0), color=colour, alpha=0.18, linewidth=0)
    return line
