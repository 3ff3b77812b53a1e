"""All pictures of recorded results: learning curves, goals, coverage, the curriculum.

A drawing takes what was recorded and the path of the PNG to write, which it returns.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from benchmarks.record_run import ASKED, BIN_M, NUM_BINS, NUM_SLICES
from benchmarks.report.skills import METHODS, by_method
from benchmarks.run_files import (
    RANDOM,
    STAGES,
    Records,
    Run,
    binned,
    mean_share,
    paths_m,
    unthin,
)  # fmt: skip
from service.base.files import write_atomic
from service.base.jsonl import JsonlWriter
from service.base.types import StateArray
from service.config import WorkspaceConfig
from service.config.run import CELL_SIZE_M
from service.media.figures import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    column,
    counted,
    new_figure,
    save,
    style_axes,
)
from service.media.plots import draw_paths, plot_goals
from service.store.run_directory import RunDirectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9", INK, "#999999")
WIDTH = 14.0
"""Width of every picture, in hundreds of pixels."""
TITLE_SIZE = 12.5
_LegendLine = tuple[str, Mapping[str, Any]]
"""A label and the keywords of its line."""


class Clock(NamedTuple):
    """Horizontal axis of a curve."""

    key: str
    unit: str
    scale: float


def _panel(axes: Axes, title: str, x: str, y: str) -> None:
    style_axes(axes)
    axes.set_title(title, loc="left", fontsize=TITLE_SIZE, weight="bold", color=INK)
    axes.set_xlabel(x, color=FAINT)
    axes.set_ylabel(y, color=FAINT)


def _tall_figure(height: float, title: str) -> Figure:
    """A figure whose title keeps its distance from the top, whatever the height."""
    figure = new_figure(WIDTH, height, "")
    figure.text(0.02, 1.0 - 0.35 / height, title, fontsize=15, weight="bold", color=INK, va="center")
    return figure


def _legend(figure: Figure, lines: Sequence[_LegendLine], y: float, num_columns: int) -> None:
    """A legend at the upper left with a line, by its keywords, for each label."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], label=label, **keywords) for label, keywords in lines]
    figure.legend(handles=handles, loc="upper left", ncols=num_columns, frameon=False, bbox_to_anchor=(0.015, y))


def _end(records: Records, clock: Clock) -> float:
    values: StateArray = column(records, clock.key)
    return float(np.nanmax(values)) / clock.scale


# --- learning curves --------------------------------------------------------------------------------------------------

NUM_SPANS = 60
"""Equal parts of a run's length; a curve shows the mean in each."""
IDLE_STYLE, ASKED_STYLE = (0, (4, 3)), (0, (1, 2))
MILLIONS = Clock("env_steps", "million env steps", 1e6)


class _CurvePanel(NamedTuple):
    key: str
    title: str
    share_of: str
    task: str | None = None


_CURVE_PANELS = (
    _CurvePanel("evaluation/mixed_success_last", "Random goals, mixed", "solved at the last step", "mixed"),
    _CurvePanel("evaluation/air_success_last", "Random goals in the air", "solved at the last step", "air"),
    _CurvePanel("evaluation/table_success_last", "Random goals on the table", "solved at the last step", "table"),
    _CurvePanel("bob/success_rate", "Bob on Alice's goals", "solved, of her valid goals"),
    _CurvePanel("alice/valid_fraction", "Alice's goals: valid", "of all her goals"),
    _CurvePanel("alice/lifted_fraction", "Alice's goals: lifted", "over 5 cm up, of her valid goals"),
)


def draw_curves(runs: Sequence[Run], path: Path, *, over_time: bool = False) -> Path:
    """Draw Bob's success and Alice's goals over env steps, or over wall-clock time; a colour for each run."""
    records = {str(run["name"]): unthin(run["series"]) for run in runs}
    clock = _wall_clock(list(records.values())) if over_time else MILLIONS
    end = max(_end(each, clock) for each in records.values())
    figure = new_figure(WIDTH, 8.2, f"Pre-training from scratch: {counted(len(runs), 'run')}, {end:.3g} {clock.unit}")
    idle = {row["goals"]: row for run in runs for row in run["evaluations"] if row["policy"] == "idle"}
    for place, (axes, panel) in enumerate(zip(figure.subplots(2, 3).flat, _CURVE_PANELS, strict=True)):
        _panel(axes, panel.title, clock.unit if place >= 3 else "", panel.share_of)
        for color, each in zip(COLORS, records.values(), strict=False):
            draw_curve(axes, each, panel.key, clock, color)
        if panel.task in idle:
            axes.axhline(idle[panel.task]["success_last"], color=FAINT, linewidth=1.2, linestyle=IDLE_STYLE)
        if panel.task == "mixed":
            axes.axhline(ASKED, color=INK, linewidth=1.2, linestyle=ASKED_STYLE)
        axes.set_xlim(0.0, end)
        axes.set_ylim(0.0, 1.0)
    lines: list[_LegendLine] = [(name, {"color": color}) for color, name in zip(COLORS, records, strict=False)]
    if idle:
        lines.append(("doing nothing", {"color": FAINT, "linestyle": IDLE_STYLE, "linewidth": 1.2}))
    lines.append((f"asked: {ASKED:.0%}", {"color": INK, "linestyle": ASKED_STYLE, "linewidth": 1.2}))
    _legend(figure, lines, 0.935, 6)
    figure.subplots_adjust(left=0.055, right=0.985, top=0.83, bottom=0.075, wspace=0.22, hspace=0.28)
    return save(figure, path)


def draw_curve(axes: Axes, records: Records, key: str, clock: Clock, color: str, **line: Any) -> None:
    """Draw the means of a metric in equal spans of ``clock``, joined over spans without a value."""
    end = _end(records, clock)
    middle = (np.arange(NUM_SPANS) + 0.5) / NUM_SPANS * end
    values = binned(records, key, NUM_SPANS, over=clock.key)
    known = np.isfinite(values)
    axes.plot(middle[known], values[known], color=color, clip_on=False, **{"linewidth": 2.0} | line)


def _wall_clock(records: Sequence[Records]) -> Clock:
    hours = Clock("time/wall_s", "hours", 3600.0)
    return hours if max(_end(each, hours) for each in records) >= 2.0 else Clock("time/wall_s", "minutes", 60.0)


# --- goals ------------------------------------------------------------------------------------------------------------


def draw_goals(run: Run, path: Path) -> Path:
    """Draw where a run's goals were, over time."""
    workspace = WorkspaceConfig.model_validate(run["config"]["world"]["workspace"])
    with tempfile.TemporaryDirectory() as scratch:
        directory = Path(scratch) / run["name"]  # the picture's title names it
        goals = JsonlWriter(RunDirectory(directory).goals_file)
        for record in run["goals"]:
            goals.append(record)
        picture = plot_goals(directory, workspace).read_bytes()
    write_atomic(path, picture)
    return path


COLOR_MAP = "cividis"
"""Colours that are as even to colour-blind readers as to others."""
LEAST_GOALS = 5
"""A share of fewer is not drawn."""
QUANTILE_COLOR = "#D81B60"


class _QuantileLine(NamedTuple):
    quantile: float
    words: str
    style: tuple[float, tuple[float, ...]] | Literal["solid"]


_QUANTILE_LINES = (
    _QuantileLine(0.5, "half of the goals are below", (0.0, (4.0, 2.0))),
    _QuantileLine(0.9, "nine in ten are below", "solid"),
)
_GOAL_WORDS = {"height": "height above where it rests (m)", "distance": "distance from the start (m)"}


def draw_curriculum(runs: Sequence[Run], path: Path) -> Path:
    """Draw heights and distances of goals over env steps, a row for each run, coloured by Bob's success."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    height = 1.3 + 3.6 * len(runs)
    figure = _tall_figure(height, "The curriculum: Alice's valid goals, and what Bob solves of them")
    for run, pair in zip(runs, figure.subplots(len(runs), len(_GOAL_WORDS), squeeze=False), strict=True):
        for axes, name in zip(pair, _GOAL_WORDS, strict=True):
            unit = MILLIONS.unit if run is runs[-1] else ""
            _panel(axes, f"{run['name']}: {name} of goals", unit, _GOAL_WORDS[name])
            _draw_goal_cells(axes, run["curriculum"], name)
    figure.subplots_adjust(left=0.055, right=0.9, top=1.0 - 1.2 / height, bottom=0.55 / height, wspace=0.16, hspace=0.3)
    bar = figure.add_axes((0.93, 0.55 / height, 0.013, 1.0 - 1.75 / height))
    figure.colorbar(ScalarMappable(Normalize(0.0, 1.0), COLOR_MAP), cax=bar)
    bar.set_ylabel(f"solved by Bob (white: under {LEAST_GOALS} goals)", color=FAINT)
    bar.tick_params(colors="#555555", labelsize=9, length=3)
    lines = [
        (line.words, {"color": QUANTILE_COLOR, "linewidth": 2.0, "linestyle": line.style}) for line in _QUANTILE_LINES
    ]
    _legend(figure, lines, 1.0 - 0.5 / height, 2)
    return save(figure, path)


def _draw_goal_cells(axes: Axes, curriculum: dict[str, Any], name: str) -> None:
    goals, solved = (np.array(curriculum[name][key], dtype=np.float64) for key in ("goals", "solved"))
    share = np.where(goals >= LEAST_GOALS, solved / np.maximum(goals, 1.0), np.nan)
    times = np.linspace(0.0, curriculum["env_steps"] / 1e6, NUM_SLICES + 1)
    axes.pcolormesh(times, BIN_M * np.arange(NUM_BINS[name] + 1), share.T, cmap=COLOR_MAP, vmin=0.0, vmax=1.0)
    middle = (times[1:] + times[:-1]) / 2
    for line in _QUANTILE_LINES:
        values = quantiles(goals, line.quantile)
        axes.plot(middle, values, color="white", linewidth=3.6)
        axes.plot(middle, values, color=QUANTILE_COLOR, linewidth=2.0, linestyle=line.style)
    axes.set_ylim(0.0, BIN_M * NUM_BINS[name])


def quantiles(counts: StateArray, quantile: float) -> StateArray:
    """Metres below which a share of each row's goals lie, straight within a bin, NaN in a row without goals.

    Args:
        counts: (rows, bins) goals in bins of 2.5 cm from 0 up.
        quantile: the share.
    """
    found = np.full(len(counts), np.nan)
    for row, count in enumerate(counts):
        if count.sum():
            below = np.append(0.0, np.cumsum(count))
            found[row] = BIN_M * np.interp(quantile * below[-1], below, np.arange(len(below)))
    return found


# --- coverage ---------------------------------------------------------------------------------------------------------

CELL_COLOR = "#e2e2e2"


def draw_coverage(run: Run, path: Path) -> Path:
    """Draw random compositions: a column for the random policy and for each stage, in the box and from above."""
    coverage, workspace = run["coverage"], WorkspaceConfig.model_validate(run["config"]["world"]["workspace"])
    stages = coverage["stages"]
    figure = new_figure(WIDTH, 8.4, f"{run['name']}: where random compositions of Bob's primitives take the object")
    words = f"{coverage['num_skills']} compositions of {coverage['num_steps']} steps; a dot is where the object ends"
    figure.text(0.98, 0.955, words, ha="right", va="center", color=FAINT)
    width = 0.98 / (1 + len(STAGES))
    for place, (name, stage) in enumerate(stages.items()):
        left = 0.015 + place * width
        box = figure.add_axes((left - 0.01, 0.47, width - 0.025, 0.4), projection="3d", computed_zorder=False)
        above = figure.add_axes((left + 0.035, 0.075, width - 0.05, 0.38))
        draw_paths(box, above, paths_m(stage), workspace)
        box.set(xlabel="", ylabel="", zlabel="")  # the view from above has them
        figure.text(left, 0.905, _stage_words(name, stage, stages[RANDOM]), fontsize=11, color=INK, va="top")
        above.set_ylabel("y (m)" if place == 0 else "", color=FAINT)
        _draw_table_cells(above, workspace)
    return save(figure, path)


def _draw_table_cells(above: Axes, workspace: WorkspaceConfig) -> None:
    """Draw the cells that are counted, as a grid."""
    low, high = workspace.lower_m, workspace.upper_m
    above.grid(False)
    x, y = (np.arange(low[axis], high[axis] + CELL_SIZE_M / 2, CELL_SIZE_M) for axis in (0, 1))
    above.vlines(x, low[1], high[1], color=CELL_COLOR, linewidth=0.8, zorder=0.5)
    above.hlines(y, low[0], high[0], color=CELL_COLOR, linewidth=0.8, zorder=0.5)


def _stage_words(name: str, stage: dict[str, Any], random: dict[str, Any]) -> str:
    share = f"{mean_share(stage):.0%} of the table's cells"
    if name == RANDOM:
        return f"{name}\n{share}"
    when = f"{stage['env_steps'] / 1e6:.3g} M env steps" if stage["env_steps"] else "untrained"
    return f"{name}: {when}\n{share}, {mean_share(stage) / mean_share(random):.1f} x random"


# --- skills -----------------------------------------------------------------------------------------------------------


def draw_skills(runs: Sequence[Run], path: Path) -> Path:
    """Draw random skills from above: the random policy, and a column for each method's first seed with its stages."""
    columns = [seeds[0] for seeds in by_method(runs).values()]
    coverage = columns[0]["coverage"]
    figure = new_figure(WIDTH, 8.2, "Where random skills take the object, seen from above")
    words = f"{coverage['num_skills']} skills of {coverage['num_steps']} steps; a dot is where the object ends"
    figure.text(0.98, 0.955, words, ha="right", va="center", color=FAINT)
    grid = figure.subplots(len(STAGES), 1 + len(columns), squeeze=False, sharex=True, sharey=True)
    for axes in grid[1:, 0]:
        axes.set_visible(False)
    _draw_skills_of(grid[0, 0], columns[0], RANDOM, "")  # the same in every run: its seed is fixed
    for run, line in zip(columns, grid[:, 1:].T, strict=True):
        for name, axes in zip(STAGES, line, strict=True):
            _draw_skills_of(axes, run, name, f"{METHODS[run['method']]}, ")
    figure.subplots_adjust(left=0.035, right=0.995, bottom=0.04, top=0.86, hspace=0.3, wspace=0.08)
    return save(figure, path)


def _draw_skills_of(axes: Axes, run: Run, name: str, method: str) -> None:
    """Draw the paths of a stage, where the run has it."""
    stages = run["coverage"]["stages"]
    if name not in stages:
        axes.set_visible(False)
        return
    workspace = WorkspaceConfig.model_validate(run["config"]["world"]["workspace"])
    draw_paths(None, axes, paths_m(stages[name]), workspace)
    _draw_table_cells(axes, workspace)
    axes.set(xlabel="", ylabel="")
    axes.set_title(f"{method}{_stage_words(name, stages[name], stages[RANDOM])}", fontsize=8)


def draw_skill_curves(runs: Sequence[Run], path: Path) -> Path:
    """Draw over env steps the coverage of random skills, and shares of episodes by where the object is at their end."""
    learned = by_method(runs)
    colours = dict(zip(learned, COLORS, strict=False))
    figure = new_figure(WIDTH, 8.0, "Skill discovery over env steps, a line for each seed")
    panels = (
        ("evaluation/coverage", "Random skills: table cells visited"),
        ("skills/moved_fraction", "Object moved, and inside at the end"),
        ("skills/lifted_fraction", "Object in the air, and inside at the end"),
        ("skills/outside_fraction", "Object outside the workspace at the end"),
    )
    for axes, (key, title) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        _panel(axes, title, MILLIONS.unit, "share")
        for method, seeds in learned.items():
            for run in seeds:
                draw_curve(axes, unthin(run["series"]), key, MILLIONS, colours[method])
        axes.set_ylim(0.0, 1.0)
        axes.set_xlim(left=0.0)
    _legend(figure, [(METHODS[method], {"color": colours[method]}) for method in learned], 0.95, len(learned))
    figure.subplots_adjust(left=0.05, right=0.98, top=0.87, bottom=0.08, hspace=0.35, wspace=0.12)
    return save(figure, path)
