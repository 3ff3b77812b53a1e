"""The curves of a run: six small panels over env steps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from service.media.plots.figures import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    column,
    counted,
    new_figure,
    read_records,
    save,
    style_axes,
)
from service.types import StateArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

METRICS_FILE = "metrics.jsonl"
CURVES_FILE = "curves.png"


class _Curve(NamedTuple):
    key: str
    label: str
    color: str
    dashed: bool = False


class _Panel(NamedTuple):
    title: str
    look_for: str
    unit: str
    curves: tuple[_Curve, ...]


_PANELS = (
    _Panel(
        "Alice's proposals",
        "valid settles high, lifted grows",
        "fraction",
        (
            _Curve("alice/valid_fraction", "valid", BLUE),
            _Curve("alice/lifted_fraction", "lifted", ORANGE),
            _Curve("alice/contact_fraction", "touched", GREEN),
        ),
    ),
    _Panel(
        "Bob on Alice's goals",
        "holds up while the goals get harder",
        "solved",
        (
            _Curve("bob/success_rate", "all", BLUE),
            _Curve("bob/success_rate_table", "table", GREEN),
            _Curve("bob/success_rate_air", "air", ORANGE),
        ),
    ),
    _Panel(
        "Bob on random goals",
        "grows; last: there at the last step",
        "solved",
        (
            _Curve("evaluation/table_success_ever", "table, ever", GREEN, dashed=True),
            _Curve("evaluation/table_success_last", "table, last", GREEN),
            _Curve("evaluation/air_success_ever", "air, ever", ORANGE, dashed=True),
            _Curve("evaluation/air_success_last", "air, last", ORANGE),
            _Curve("evaluation/mixed_success_last", "mixed, last", BLUE),
        ),
    ),
    _Panel(
        "How far and how high the goals are",
        "grow: Alice raises the bar",
        "metres",
        (
            _Curve("alice/goal_distance_m", "distance", BLUE),
            _Curve("alice/goal_height_m", "height", ORANGE),
            _Curve("alice/goal_height_p90_m", "height p90", ORANGE, dashed=True),
        ),
    ),
    _Panel(
        "Why proposals are refused",
        "not moved falls early, outside stays low",
        "fraction",
        (
            _Curve("alice/not_moved_fraction", "not moved", BLUE),
            _Curve("alice/outside_fraction", "outside", ORANGE),
        ),
    ),
    _Panel(
        "Entropy of the policies",
        "falls slowly, without a collapse",
        "nats",
        (_Curve("learner/alice_entropy", "Alice", ORANGE), _Curve("learner/bob_entropy", "Bob", BLUE)),
    ),
)


def plot_curves(run_dir: Path) -> Path:
    """Draw ``curves.png`` from the run's ``metrics.jsonl``: six small panels over env steps, raw thin, smoothed thick.

    A value that is missing, null or not finite leaves a gap; a panel without values says so.

    Raises:
        TandemError: the run has no metrics yet, they are damaged, or the picture cannot be written.
    """
    records = read_records(run_dir / METRICS_FILE)
    steps = column(records, "env_steps") / 1e6
    figure = new_figure(14.0, 7.8, f"{run_dir.resolve().name}: {_progress(records)}")
    for place, (axes, panel) in enumerate(zip(figure.subplots(2, 3).flat, _PANELS, strict=True)):
        _draw_panel(axes, panel, steps, records)
        axes.set_xlabel("million env steps" if place >= 3 else "", color=FAINT)
    figure.subplots_adjust(left=0.05, right=0.908, top=0.85, bottom=0.08, wspace=0.64, hspace=0.42)
    return save(figure, run_dir / CURVES_FILE)


def _progress(records: Sequence[dict[str, Any]]) -> str:
    steps, seconds = (column(records, key) for key in ("env_steps", "time/wall_s"))
    words = [counted(len(records), "iteration")]
    if np.isfinite(steps).any():
        words.append(f"{np.nanmax(steps) / 1e6:.2f} M env steps")
    if np.isfinite(seconds).any():
        words.append(f"{np.nanmax(seconds) / 60:.0f} min")
    return ", ".join(words)


def _smooth(values: StateArray, span: float) -> StateArray:
    """The exponential moving average with Adam's correction for its start, so the first value is not favoured."""
    decay = 1.0 - 2.0 / (span + 1.0)
    average = weight = 0.0
    smoothed = np.empty_like(values)
    for index, value in enumerate(values):
        average = decay * average + (1.0 - decay) * value
        weight = decay * weight + (1.0 - decay)
        smoothed[index] = average / weight
    return smoothed


def _draw_panel(axes: Axes, panel: _Panel, steps: StateArray, records: Sequence[dict[str, Any]]) -> None:
    style_axes(axes)
    axes.set_title(panel.title, loc="left", fontsize=12, weight="bold", color=INK, pad=20)
    axes.text(0.0, 1.03, panel.look_for, transform=axes.transAxes, fontsize=9.5, color="#666666")
    axes.set_ylabel(panel.unit, color=FAINT)
    if np.isfinite(steps).any():
        axes.set_xlim(0.0, max(float(np.nanmax(steps)), 1e-6))
    ends = [(_draw_curve(axes, curve, steps, column(records, curve.key)), curve) for curve in panel.curves]
    drawn = [(end, curve) for end, curve in ends if end is not None]
    if not drawn:
        axes.text(0.5, 0.5, "no values yet", transform=axes.transAxes, ha="center", color=FAINT)
    if panel.unit != "nats":
        axes.set_ylim(0.0, 1.0 if panel.unit != "metres" else None)
    _label_ends(axes, drawn)


def _draw_curve(axes: Axes, curve: _Curve, steps: StateArray, values: StateArray) -> float | None:
    """Draw one curve; the height at which it ends, None when it has no values."""
    known = np.isfinite(values) & np.isfinite(steps)
    x, y = steps[known], values[known]
    if not len(x):
        return None
    style = (0, (4, 2)) if curve.dashed else "solid"
    if curve.key.startswith("evaluation/"):
        # few, and each over many episodes: shown as they are
        axes.plot(x, y, color=curve.color, linestyle=style, linewidth=1.8, marker="o", markersize=4, clip_on=False)
        return float(y[-1])
    smoothed = _smooth(y, span=float(np.clip(len(y) / 16, 1, 15)))
    axes.plot(x, y, color=curve.color, linewidth=0.7, alpha=0.3)
    axes.plot(x, smoothed, color=curve.color, linestyle=style, linewidth=2.2)
    axes.plot(x[-1:], smoothed[-1:], color=curve.color, marker="o", markersize=4.5, clip_on=False)
    return float(smoothed[-1])


def _label_ends(axes: Axes, ends: Sequence[tuple[float, _Curve]]) -> None:
    """Write each curve's name and last value right of its end, pushed apart where two would overlap."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high)
    floor = -np.inf
    ordered = sorted(ends, key=lambda end: end[0])
    for place, (value, curve) in enumerate(ordered):
        room = 1.0 - 0.085 * (len(ordered) - 1 - place)
        height = min(max((value - low) / (high - low), floor + 0.085), max(room, floor + 0.085))
        floor = height
        text = f"{curve.label} {value:.2f}"
        axes.text(1.03, height, text, transform=axes.transAxes, va="center", fontsize=9.5, color=curve.color)
