"""Success of a run that is shot at beside undisturbed ones, and the memory of every process of a long run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.pictures.curves import Clock, draw_curve
from benchmarks.run_files import unthin
from service.media.plots.figures import BLUE, FAINT, GREEN, INK, ORANGE, new_figure, save, style_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

THOUSANDS = Clock("env_steps", "thousand env steps", 1e3)
STRUCK = {"actor": FAINT, "learner": ORANGE, "generator": GREEN, "status": "#CC79A7", "redis": "#E69F00"}
CURVES = (("bob/success_rate", "Bob on Alice's valid goals", "solved"), ("alice/valid_fraction", "Alice", "valid"))
OURS = ("driver", "actor", "learner", "generator", "status", "redis")
COLORS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9", INK, "#999999")


def draw_chaos(result: Mapping[str, Any], path: Path) -> Path:
    """Draw both players' success over env steps, and at what every strike was."""
    from matplotlib.lines import Line2D

    figure = new_figure(14.0, 5.2, "A run that is shot at, beside undisturbed ones")
    curves = result["curves"]
    for axes, (key, title, label) in zip(figure.subplots(1, 2), CURVES, strict=True):
        style_axes(axes)
        for each in curves["undisturbed"]:
            draw_curve(axes, unthin(each["series"]), key, THOUSANDS, "#9ecae1")
        draw_curve(axes, unthin(curves["disturbed"]["series"]), key, THOUSANDS, BLUE)
        for strike in result["strikes"]:
            axes.axvline(strike["num_env_steps"] / 1e3, color=STRUCK[strike["target"]], linewidth=0.9, alpha=0.7)
        axes.set_title(title, loc="left", fontsize=12.5, weight="bold", color=INK)
        axes.set_ylabel(f"{label}, share", color=FAINT)
        axes.set_xlabel(THOUSANDS.unit, color=FAINT)
        axes.set_ylim(0.0, 1.0)
        axes.set_xlim(0.0, curves["disturbed"]["env_steps"] / 1e3)
    handles = [Line2D([], [], color=BLUE, label="shot at"), Line2D([], [], color="#9ecae1", label="undisturbed")]
    handles += [Line2D([], [], color=color, linewidth=0.9, label=f"{name} killed") for name, color in STRUCK.items()]
    figure.legend(handles=handles, loc="upper left", ncols=7, frameon=False, bbox_to_anchor=(0.015, 0.92))
    figure.subplots_adjust(left=0.055, right=0.985, top=0.76, bottom=0.11, wspace=0.18)
    return save(figure, path)


def draw_soak(result: Mapping[str, Any], path: Path) -> Path:
    """Draw the own memory of the run's processes, and of Ray's."""
    figure = new_figure(14.0, 5.6, "Memory of every process, without files, shared memory and history")
    found = result["processes"]
    for axes, title, ours in zip(figure.subplots(1, 2), ("The run", "Ray's own"), (True, False), strict=True):
        style_axes(axes)
        shown = {name: each for name, each in found.items() if (each["role"] in OURS) == ours}
        _draw_memory(axes, shown)
        axes.set_title(title, loc="left", fontsize=12.5, weight="bold", color=INK)
        axes.set_ylabel("MB", color=FAINT)
        axes.set_xlabel("thousand updates", color=FAINT)
        axes.set_ylim(bottom=0.0)
        axes.set_xlim(0.0, result["num_iterations"] / 1e3)
        axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.14), ncols=4, frameon=False, fontsize=9)
    figure.subplots_adjust(left=0.05, right=0.985, top=0.85, bottom=0.26, wspace=0.14)
    return save(figure, path)


def _draw_memory(axes: Axes, shown: Mapping[str, Mapping[str, Any]]) -> None:
    for index, (name, each) in enumerate(shown.items()):
        x = [iteration / 1e3 for iteration in each["series"]["iteration"]]
        style = "-" if index < len(COLORS) else "--"
        axes.plot(x, each["series"]["own_mb"], style, color=COLORS[index % len(COLORS)], linewidth=1.6, label=name)
