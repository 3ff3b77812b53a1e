"""The curriculum that Alice makes: how high and how far her goals are over a run, and what Bob solves of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from benchmarks.curriculum import BIN_M, NUM_BINS, NUM_SLICES
from benchmarks.run_files import Run
from service.media.plots.figures import FAINT, INK, Array, new_figure, save, style_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOR_MAP = "cividis"
"""As even to colour-blind readers as to others."""
LEAST_GOALS = 5
"""A share of fewer is not drawn."""
LINE_COLOR = "#D81B60"


class _Line(NamedTuple):
    quantile: float
    words: str
    style: tuple[float, tuple[float, ...]] | Literal["solid"]


_LINES = (
    _Line(0.5, "half of the goals are below", (0.0, (4.0, 2.0))),
    _Line(0.9, "nine in ten are below", "solid"),
)
_WORDS = {"height": "height above where it rests (m)", "distance": "distance from the start (m)"}


def draw_curriculum(runs: Sequence[Run], path: Path) -> Path:
    """Draw how high and how far goals are over env steps, a row for each run, coloured by Bob's success."""
    height = 1.3 + 3.6 * len(runs)
    figure = new_figure(14.0, height, "")
    title = "The curriculum: Alice's valid goals, and what Bob solves of them"
    figure.text(0.02, 1.0 - 0.35 / height, title, fontsize=15, weight="bold", color=INK, va="center")
    for run, pair in zip(runs, figure.subplots(len(runs), len(_WORDS), squeeze=False), strict=True):
        for axes, name in zip(pair, _WORDS, strict=True):
            _draw_cells(axes, run["curriculum"], name)
            axes.set_title(f"{run['name']}: {name} of goals", loc="left", fontsize=12.5, weight="bold", color=INK)
            axes.set_ylabel(_WORDS[name], color=FAINT)
    for axes in pair:
        axes.set_xlabel("million env steps", color=FAINT)
    figure.subplots_adjust(left=0.055, right=0.9, top=1.0 - 1.2 / height, bottom=0.55 / height, wspace=0.16, hspace=0.3)
    _legend(figure, height)
    return save(figure, path)


def _draw_cells(axes: Axes, curriculum: dict[str, Any], name: str) -> None:
    goals, solved = (np.array(curriculum[name][key], dtype=np.float64) for key in ("goals", "solved"))
    share = np.where(goals >= LEAST_GOALS, solved / np.maximum(goals, 1.0), np.nan)
    times = np.linspace(0.0, curriculum["env_steps"] / 1e6, NUM_SLICES + 1)
    style_axes(axes)
    axes.pcolormesh(times, BIN_M * np.arange(NUM_BINS[name] + 1), share.T, cmap=COLOR_MAP, vmin=0.0, vmax=1.0)
    middle = (times[1:] + times[:-1]) / 2
    for line in _LINES:
        values = quantiles(goals, line.quantile)
        axes.plot(middle, values, color="white", linewidth=3.6)
        axes.plot(middle, values, color=LINE_COLOR, linewidth=2.0, linestyle=line.style)
    axes.set_ylim(0.0, BIN_M * NUM_BINS[name])


def quantiles(counts: Array, quantile: float) -> Array:
    """The metres under which a share of each row's goals lie, straight within a bin, NaN in a row without goals.

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


def _legend(figure: Figure, height: float) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.lines import Line2D

    bar = figure.add_axes((0.93, 0.55 / height, 0.013, 1.0 - 1.75 / height))
    figure.colorbar(ScalarMappable(Normalize(0.0, 1.0), COLOR_MAP), cax=bar)
    bar.set_ylabel(f"solved by Bob (white: under {LEAST_GOALS} goals)", color=FAINT)
    bar.tick_params(colors="#555555", labelsize=9, length=3)
    lines = [Line2D([], [], color=LINE_COLOR, linewidth=2.0, linestyle=line.style, label=line.words) for line in _LINES]
    figure.legend(handles=lines, loc="upper left", ncols=2, frameon=False, bbox_to_anchor=(0.015, 1.0 - 0.5 / height))
