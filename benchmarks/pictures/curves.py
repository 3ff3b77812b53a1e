"""Learning curves of several runs, a colour each, over env steps or over wall-clock time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from benchmarks.run_files import Records, Run, binned, unthin
from benchmarks.tasks import ASKED
from service.media.plots.figures import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    Array,
    column,
    counted,
    new_figure,
    save,
    style_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NUM_BINS = 60
"""Of a run's length; a curve shows the mean in each."""
COLORS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9")
IDLE_STYLE, ASKED_STYLE = (0, (4, 3)), (0, (1, 2))


class Clock(NamedTuple):
    """What a curve goes over."""

    key: str
    unit: str
    scale: float


class _Panel(NamedTuple):
    key: str
    title: str
    share_of: str
    task: str | None = None


_PANELS = (
    _Panel("evaluation/mixed_success_last", "Random goals, mixed", "solved at the last step", "mixed"),
    _Panel("evaluation/air_success_last", "Random goals in the air", "solved at the last step", "air"),
    _Panel("evaluation/table_success_last", "Random goals on the table", "solved at the last step", "table"),
    _Panel("bob/success_rate", "Bob on Alice's goals", "solved, of her valid goals"),
    _Panel("alice/valid_fraction", "Alice's goals: valid", "of all her goals"),
    _Panel("alice/lifted_fraction", "Alice's goals: lifted", "over 5 cm up, of her valid goals"),
)


def draw_curves(runs: Sequence[Run], path: Path, *, over_time: bool = False) -> Path:
    """Draw Bob's success and Alice's goals over env steps, or over wall-clock time.

    Args:
        runs: recorded ones, at least one.
        path: the PNG to write.
        over_time: of the wall clock.
    """
    records = {str(run["name"]): unthin(run["series"]) for run in runs}
    clock = _wall_clock(list(records.values())) if over_time else Clock("env_steps", "million env steps", 1e6)
    end = max(_end(each, clock) for each in records.values())
    figure = new_figure(14.0, 8.2, f"Pre-training from scratch: {counted(len(runs), 'run')}, {end:.3g} {clock.unit}")
    idle = {row["goals"]: row for run in runs for row in run["evaluations"] if row["policy"] == "idle"}
    for place, (axes, panel) in enumerate(zip(figure.subplots(2, 3).flat, _PANELS, strict=True)):
        style_axes(axes)
        axes.set_title(panel.title, loc="left", fontsize=12.5, weight="bold", color=INK)
        axes.set_ylabel(panel.share_of, color=FAINT)
        axes.set_xlabel(clock.unit if place >= 3 else "", color=FAINT)
        for color, each in zip(COLORS, records.values(), strict=False):
            draw_curve(axes, each, panel.key, clock, color)
        if panel.task in idle:
            axes.axhline(idle[panel.task]["success_last"], color=FAINT, linewidth=1.2, linestyle=IDLE_STYLE)
        if panel.task == "mixed":
            axes.axhline(ASKED, color=INK, linewidth=1.2, linestyle=ASKED_STYLE)
        axes.set_xlim(0.0, end)
        axes.set_ylim(0.0, 1.0)
    _legend(figure, list(records), bool(idle))
    figure.subplots_adjust(left=0.055, right=0.985, top=0.83, bottom=0.075, wspace=0.22, hspace=0.28)
    return save(figure, path)


def draw_curve(axes: Axes, records: Records, key: str, clock: Clock, color: str) -> None:
    """Draw the means of a metric in equal spans of ``clock``, joined over spans without a value."""
    end = _end(records, clock)
    middle = (np.arange(NUM_BINS) + 0.5) / NUM_BINS * end
    values = binned(records, key, NUM_BINS, over=clock.key)
    known = np.isfinite(values)
    axes.plot(middle[known], values[known], color=color, linewidth=2.0, clip_on=False)


def _wall_clock(records: Sequence[Records]) -> Clock:
    hours = Clock("time/wall_s", "hours", 3600.0)
    return hours if max(_end(each, hours) for each in records) >= 2.0 else Clock("time/wall_s", "minutes", 60.0)


def _end(records: Records, clock: Clock) -> float:
    values: Array = column(records, clock.key)
    return float(np.nanmax(values)) / clock.scale


def _legend(figure: Figure, names: Sequence[str], idle: bool) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=color, label=name) for color, name in zip(COLORS, names, strict=False)]
    if idle:
        handles.append(Line2D([], [], color=FAINT, linestyle=IDLE_STYLE, linewidth=1.2, label="doing nothing"))
    handles.append(Line2D([], [], color=INK, linestyle=ASKED_STYLE, linewidth=1.2, label=f"asked: {ASKED:.0%}"))
    figure.legend(handles=handles, loc="upper left", ncols=6, frameon=False, bbox_to_anchor=(0.015, 0.935))
