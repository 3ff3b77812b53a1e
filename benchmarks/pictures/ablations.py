"""Small learning curves: every ablation over the whole recipe."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from benchmarks.ablations import RECIPE
from benchmarks.pictures.curves import Clock, draw_curve
from benchmarks.run_files import Run, unthin
from service.media.plots.figures import BLUE, FAINT, GREEN, INK, column, new_figure, save, style_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NUM_COLUMNS = 4
ENV_STEPS = Clock("env_steps", "million env steps", 1e6)
RECIPE_STYLE = (0, (2, 1.5))


class _Curve(NamedTuple):
    key: str
    label: str
    color: str


_CURVES = (
    _Curve("evaluation/mixed_success_last", "mixed goals", BLUE),
    _Curve("evaluation/table_success_last", "goals on the table", GREEN),
)


def draw_ablations(runs: Sequence[Run], path: Path) -> Path:
    """Draw a panel for each ablation: Bob's success on random goals, and dashed that of the whole recipe.

    Args:
        runs: recorded ablations; those of the recipe itself are drawn into every panel.
        path: the PNG to write.
    """
    names = list(dict.fromkeys(run["ablation"]["name"] for run in runs if run["ablation"]["name"] != RECIPE))
    num_rows = max(-(-len(names) // NUM_COLUMNS), 1)
    height = 1.6 + 2.9 * num_rows
    figure = new_figure(14.0, height, "")
    title = "Ablations: Bob on random goals, solved at the last step"
    figure.text(0.02, 1.0 - 0.35 / height, title, fontsize=15, weight="bold", color=INK, va="center")
    panels = list(figure.subplots(num_rows, NUM_COLUMNS, squeeze=False).flat)
    for axes in panels[len(names) :]:
        axes.set_visible(False)
    end = max(run["series"]["env_steps"][-1] for run in runs) / 1e6
    for axes, name in zip(panels, names, strict=False):
        shown = [run for run in runs if run["ablation"]["name"] in (name, RECIPE)]
        _draw_panel(axes, shown)
        axes.set_xlim(0.0, end)
        axes.set_ylim(0.0, _top(runs))
        axes.set_title(name, loc="left", fontsize=12, weight="bold", color=INK)
    figure.supxlabel(ENV_STEPS.unit, y=0.12 / height, color=FAINT, fontsize=10)
    figure.subplots_adjust(
        left=0.04, right=0.985, top=1.0 - 1.25 / height, bottom=0.7 / height, wspace=0.16, hspace=0.34
    )
    _legend(figure, height)
    return save(figure, path)


def _draw_panel(axes: Axes, runs: Sequence[Run]) -> None:
    style_axes(axes)
    for run in sorted(runs, key=lambda run: run["ablation"]["name"] != RECIPE):  # the recipe below
        whole = run["ablation"]["name"] == RECIPE
        for curve in _CURVES:
            draw_curve(axes, unthin(run["series"]), curve.key, ENV_STEPS, curve.color)
            axes.lines[-1].set(linestyle=RECIPE_STYLE if whole else "solid", linewidth=1.3 if whole else 2.2)


def _legend(figure: Figure, height: float) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=curve.color, linewidth=2.2, label=curve.label) for curve in _CURVES]
    handles.append(Line2D([], [], color=INK, linewidth=1.3, linestyle=RECIPE_STYLE, label="the whole recipe"))
    figure.legend(handles=handles, loc="upper left", ncols=3, frameon=False, bbox_to_anchor=(0.015, 1.0 - 0.5 / height))


def _top(runs: Sequence[Run]) -> float:
    """A little over the highest success, for a common scale."""
    values = [column(unthin(run["series"]), curve.key) for run in runs for curve in _CURVES]
    return min(1.0, 1.15 * float(np.nanmax(np.concatenate(values), initial=0.1)))
