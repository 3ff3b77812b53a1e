"""Learning curves: of one training, and of a whole table with the spread over seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from service.downstream.directory import TRIAL
from service.downstream.methods import METHODS
from service.envs.tasks import TASKS
from service.media.plots.figures import BLUE, FAINT, GREEN, ORANGE, column, new_figure, read_records, save, style_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

_COLOURS = (BLUE, "#56B4E9", "#000000", GREEN, ORANGE, "#CC79A7", "#E69F00", "#999999")
Results = Sequence[Mapping[str, Any]]


def draw_training(path: Path) -> Path:
    """Draw ``curves.png`` of a training from its ``metrics.jsonl``: success, return, and how fast.

    Raises:
        TandemError: no metrics yet, or the picture cannot be written.
    """
    records = read_records(path / "metrics.jsonl")
    steps = column(records, "env_steps") / 1e3
    figure = new_figure(12.0, 4.2, path.resolve().name)
    panels = (
        ("success", ("evaluation/success_last", "evaluation/success_ever", "rollout/success_last")),
        ("return of an episode, with noise", ("rollout/return",)),
        ("entropy coefficient", ("train/ent_coef",)),
    )
    for axes, (title, keys) in zip(figure.subplots(1, 3), panels, strict=True):
        for key, colour in zip(keys, (BLUE, GREEN, FAINT), strict=False):
            values = column(records, key)
            known = np.isfinite(values)
            axes.plot(steps[known], values[known], color=colour, linewidth=1.4, label=key)
        _finish(axes, title)
        axes.legend(fontsize=8, frameon=False)
    figure.subplots_adjust(left=0.06, right=0.98, top=0.82, bottom=0.15)
    return save(figure, path / "curves.png")


def draw_table(results: Results, path: Path) -> Path:
    """Draw success at the last step over env steps: a panel per task, a line per method, a band from least to greatest.

    Raises:
        TandemError: the picture cannot be written.
    """
    figure = new_figure(14.0, 8.0, "Success at the last step, over thousands of env steps")
    lines: dict[str, Line2D] = {}
    longest = max((each["env_steps"] for each in results), default=0) / 1e3
    for axes, (name, task) in zip(figure.subplots(2, 3).flat, TASKS.items(), strict=True):
        for (method, described), colour in zip(METHODS.items(), cycle(_COLOURS), strict=False):
            chosen = [each for each in results if each[TRIAL]["task"] == name and each[TRIAL]["method"] == method]
            if chosen:
                lines[described.title] = _draw_method(axes, chosen, colour)
        _finish(axes, task.title)
        axes.set_ylim(-0.02, 1.02)
        axes.set_xlim(0.0, 1.02 * longest or 1.0)
    titles = [described.title for described in METHODS.values() if described.title in lines]
    figure.legend([lines[title] for title in titles], titles, loc="upper right", ncols=4, fontsize=9, frameon=False)
    figure.subplots_adjust(left=0.05, right=0.98, top=0.86, bottom=0.07, hspace=0.3)
    return save(figure, path)


def _draw_method(axes: Axes, results: Results, colour: str) -> Line2D:
    """Mean line of several seeds and their range; a level for a method that learns nothing. Returns the line."""
    curves = [result["curve"] for result in results]
    if not all(curves):
        level = float(np.mean([result["evaluation"]["success_last"] for result in results]))
        return axes.axhline(level, color=colour, linewidth=1.0, linestyle=":")
    num = min(len(curve) for curve in curves)
    steps = np.array([point["env_steps"] for point in curves[0][:num]]) / 1e3
    values = np.array([[point["success_last"] for point in curve[:num]] for curve in curves])
    (line,) = axes.plot(steps, values.mean(0), color=colour, linewidth=1.6)
    if len(curves) > 1:
        axes.fill_between(steps, values.min(0), values.max(0), color=colour, alpha=0.18, linewidth=0)
    return line


def _finish(axes: Axes, title: str) -> None:
    style_axes(axes)
    axes.set_title(title, loc="left", fontsize=11)
    axes.set_xlabel("env steps, thousands", color=FAINT, fontsize=9)
