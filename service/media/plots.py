"""Plots of a run: its curves, its goals, and the coverage of random compositions of its primitives.

matplotlib is loaded by the first call, not by the import.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import accumulate, combinations, cycle, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from service.actors.coverage import visited_share
from service.base.errors import TandemError
from service.base.types import StateArray
from service.config import WorkspaceConfig
from service.generator.records import of_furthest
from service.media.figures import (
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
from service.store.models import GOALS_FILE, METRICS_FILE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARGIN_M = 0.03
"""Drawn surroundings of the workspace."""
_COLORS = (BLUE, ORANGE, GREEN, "#CC79A7", "#56B4E9", "#E69F00")
"""Of runs side by side."""
_EDGE_STYLE = (0, (4, 3))

# --- curves ----------------------------------------------------------------------------------------------------------


class _Curve(NamedTuple):
    key: str
    label: str
    color: str
    dashed: bool = False


class _Panel(NamedTuple):
    title: str
    look_for: str
    unit: str
    curves: Sequence[_Curve] = ()


_BOB = _Panel(
    "Bob on Alice's goals",
    "holds up while the goals get harder",
    "solved",
    (
        _Curve("bob/success_rate", "all", BLUE),
        _Curve("bob/success_rate_table", "table", GREEN),
        _Curve("bob/success_rate_air", "air", ORANGE),
    ),
)
_RANDOM = _Panel(
    "Bob on random goals",
    "grows; last: there at the last step",
    "solved",
    (
        _Curve("evaluation/table_success_ever", "table, ever", GREEN, dashed=True),
        _Curve("evaluation/table_success_last", "table, last", GREEN),
        _Curve("evaluation/air_success_ever", "air, ever", ORANGE, dashed=True),
        _Curve("evaluation/air_success_last", "air, last", ORANGE),
        _Curve("evaluation/mixed_success_last", "mixed, last", BLUE),
        _Curve("evaluation/one_success_last", "one, last", "#CC79A7"),
    ),
)
_SELF_PLAY = (
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
    _BOB,
    _RANDOM,
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
_SKILLS = (
    _Panel(
        "What episodes do to the object",
        "moved grows",
        "fraction",
        (
            _Curve("skills/moved_fraction", "moved", BLUE),
            _Curve("skills/lifted_fraction", "lifted", ORANGE),
            _Curve("skills/outside_fraction", "outside", GREEN),
        ),
    ),
    _Panel("Coverage of random skills", "grows", "fraction", (_Curve("evaluation/coverage", "32 skills", BLUE),)),
    _Panel("Cells in which episodes ended", "grow", "cells", (_Curve("skills/num_cells_seen", "ever", BLUE),)),
    _Panel("How far the object came", "grows", "metres", (_Curve("skills/distance_m", "distance", BLUE),)),
    _Panel("Loss of the reward's network", "settles", "", (_Curve("learner/representation_loss", "loss", BLUE),)),
    _Panel(
        "Entropy of the policy",
        "falls slowly, without a collapse",
        "nats",
        (_Curve("learner/entropy", "policy", BLUE),),
    ),
)
_DISTILLATION = (
    _Panel(
        "The student on random goals",
        "grows, with noise and random actions",
        "solved",
        (_Curve("bob/success_rate", "own gate", BLUE),),
    ),
    _RANDOM,
    _Panel(
        "Error of actions",
        "falls; noise of what is seen leaves a rest",
        "squared",
        (_Curve("learner/action_error", "error", BLUE),),
    ),
    _Panel("Error of primitives", "falls", "squared", (_Curve("learner/primitives_error", "error", BLUE),)),
    _Panel("Error of the gate", "falls", "squared, of logs", (_Curve("learner/gate_error", "error", BLUE),)),
    _Panel("Learning rate", "falls", "", (_Curve("learner/learning_rate", "rate", BLUE),)),
)
_TASK = (
    _Panel(
        "The task",
        "last: there at the last step",
        "solved",
        (
            _Curve("evaluation/success_last", "last", BLUE),
            _Curve("evaluation/success_ever", "ever", GREEN, dashed=True),
            _Curve("rollout/success_last", "learning", ORANGE),
        ),
    ),
    _Panel("Return of an episode", "grows", "steps at the goal", (_Curve("rollout/return", "with noise", BLUE),)),
    _Panel("Entropy coefficient", "falls", "", (_Curve("learner/entropy_coefficient", "weight", BLUE),)),
)
_PANELS = {"self-play": _SELF_PLAY, "skills": _SKILLS, "distillation": _DISTILLATION}
"""Panels by method; those of learning a task are the same for all of its methods."""


def plot_curves(run_dir: Path, method: str = "self-play") -> Path:
    """Draw ``curves.png`` from the run's ``metrics.jsonl``: small panels over env steps, raw thin, smoothed thick.

    A value that is missing, null or not finite leaves a gap; a panel without values says so.

    Args:
        run_dir: of the run.
        method: of the run, which says what there is to draw.

    Raises:
        TandemError: the run has no metrics yet, they are damaged, or the picture cannot be written.
    """
    records = read_records(run_dir / METRICS_FILE)
    panels = _PANELS.get(method, _TASK)
    num_rows = len(panels) // 3
    figure = new_figure(14.0, 3.9 * num_rows, f"{run_dir.resolve().name}: {_progress(records)}")
    for axes, panel in zip(figure.subplots(num_rows, 3).flat, panels, strict=True):
        _draw_panel(axes, panel, [(curve, records) for curve in panel.curves])
    edges = {"left": 0.05, "right": 0.908, "top": 1.0 - 0.3 / num_rows, "bottom": 0.16 / num_rows}
    figure.subplots_adjust(**edges, wspace=0.64, hspace=0.46)
    return save(figure, run_dir / "curves.png")


_OF_STUDIES = ((_RANDOM.title, "evaluation/mixed_success_last"), (_BOB.title, "bob/success_rate"))
_OF_TASKS = (("Evaluated", "evaluation/success_last"), ("While learning, with noise", "rollout/success_last"))
"""Curves of a study, with their titles."""


def plot_study(run_dirs: Mapping[str, Path], path: Path) -> Path:
    """Draw the success of several runs side by side: on random goals and on Alice's, or on their tasks.

    Args:
        run_dirs: run directories by label; one without metrics is left out.
        path: of the picture.

    Raises:
        TandemError: no run has metrics yet, or the picture cannot be written.
    """
    found = {}
    for label, run_dir in run_dirs.items():
        with suppress(TandemError):
            found[label] = read_records(run_dir / METRICS_FILE)
    if not found:
        raise TandemError(f"no run in {path.parent} has metrics yet; wait for a first iteration")
    figure = new_figure(14.0, 5.2, f"{path.parent.resolve().name}: {counted(len(found), 'run')}")
    tasks = any("rollout/success_last" in record for records in found.values() for record in records[-1:])
    for axes, (title, key) in zip(figure.subplots(1, 2), _OF_TASKS if tasks else _OF_STUDIES, strict=True):
        runs = zip(found.items(), cycle(_COLORS), strict=False)
        curves = [(_Curve(key, label, color), records) for (label, records), color in runs]
        _draw_panel(axes, _Panel(title, key.split("/")[1], "solved"), curves)
    figure.subplots_adjust(left=0.05, right=0.908, top=0.8, bottom=0.12, wspace=0.3)
    return save(figure, path)


def _progress(records: Sequence[dict[str, Any]]) -> str:
    steps = column(records, "env_steps")
    done = f", {np.nanmax(steps) / 1e6:.2f} M env steps" if np.isfinite(steps).any() else ""
    return counted(len(records), "iteration") + done


def _smooth(values: StateArray, span: float) -> StateArray:
    """The exponential moving average with Adam's correction for its start, so the first value is not favoured."""
    decay = 1.0 - 2.0 / (span + 1.0)
    averages = accumulate((1.0 - decay) * values, lambda average, value: decay * average + value)
    smoothed: StateArray = np.array(list(averages)) / (1.0 - decay ** np.arange(1, len(values) + 1))
    return smoothed


def _draw_panel(axes: Axes, panel: _Panel, curves: Sequence[tuple[_Curve, Sequence[dict[str, Any]]]]) -> None:
    """Draw curves, each of a run's records."""
    style_axes(axes)
    axes.set_title(panel.title, loc="left", fontsize=12, weight="bold", color=INK, pad=20)
    axes.text(0.0, 1.03, panel.look_for, transform=axes.transAxes, fontsize=9.5, color="#666666")
    axes.set_xlabel("million env steps", color=FAINT)
    axes.set_ylabel(panel.unit, color=FAINT)
    ends = [(_draw_curve(axes, curve, records), curve) for curve, records in curves]
    drawn = [(end, curve) for end, curve in ends if end is not None]
    if not drawn:
        axes.text(0.5, 0.5, "no values yet", transform=axes.transAxes, ha="center", color=FAINT)
    axes.set_xlim(left=0.0)
    if panel.unit in ("fraction", "solved"):
        axes.set_ylim(0.0, 1.0)
    elif panel.unit in ("metres", "cells"):
        axes.set_ylim(0.0)
    _label_ends(axes, drawn)


def _draw_curve(axes: Axes, curve: _Curve, records: Sequence[dict[str, Any]]) -> float | None:
    """Draw one curve; the height at which it ends, None when it has no values."""
    steps, values = column(records, "env_steps") / 1e6, column(records, curve.key)
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


# --- goals -----------------------------------------------------------------------------------------------------------

_NUM_SLICES = 4


def plot_goals(run_dir: Path, workspace: WorkspaceConfig) -> Path:
    """Draw ``goals.png`` from the run's ``goals.jsonl``: where valid goals are, in four slices of time, solved or not.

    The top row looks from above, with the workspace's outline; the bottom row shows how far a goal is from where the
    object started and how high it is above the table.

    Raises:
        TandemError: the run has no goals yet, they are damaged, or the picture cannot be written.
    """
    from matplotlib.lines import Line2D

    records = read_records(run_dir / GOALS_FILE)
    figure = new_figure(14.0, 7.8, f"{run_dir.resolve().name}: where Alice's goals are, and which of them Bob solves")
    columns = figure.subplots(2, _NUM_SLICES, sharex="row", sharey="row").T
    for (above, side), slice_ in zip(columns, np.array_split(np.arange(len(records)), _NUM_SLICES), strict=True):
        chosen = [records[index] for index in slice_]
        goals = _goals(chosen)
        _draw_goals(above, side, goals, workspace)
        above.set_title(_slice_title(chosen, goals), loc="left", fontsize=11, color=INK)
    columns[0][1].set_xlim(left=0.0)
    columns[0][0].set_ylabel("from above: y (m)", color=INK)
    columns[0][1].set_ylabel("height above the table (m)", color=INK)
    dots = {"solved by Bob": BLUE, "not solved": ORANGE}
    handles = [Line2D([], [], color=color, marker="o", linestyle="", label=label) for label, color in dots.items()]
    edge = Line2D([], [], color=INK, linestyle=_EDGE_STYLE, linewidth=1.0, label="edge of the workspace")
    figure.legend(handles=[*handles, edge], loc="upper right", ncols=3, frameon=False, bbox_to_anchor=(0.99, 0.985))
    figure.subplots_adjust(left=0.055, right=0.985, top=0.83, bottom=0.075, wspace=0.08, hspace=0.22)
    return save(figure, run_dir / "goals.png")


def _goals(records: Sequence[dict[str, Any]]) -> StateArray:
    """The records' goals, (number, 7): start xyz, goal xyz, solved; any that is not finite is left out.

    Of several objects, those of the one that goes furthest.
    """
    goals = of_furthest([row for record in records for row in record.get("goals") or ()])
    return goals[np.isfinite(goals).all(axis=1)]


def _slice_title(records: Sequence[dict[str, Any]], goals: StateArray) -> str:
    steps = column(records, "env_steps") / 1e6
    when = f"{np.nanmin(steps):.2f} to {np.nanmax(steps):.2f} M env steps" if np.isfinite(steps).any() else ""
    rate = f"{counted(len(goals), 'goal')}, {goals[:, 6].mean():.0%} solved" if len(goals) else "no goals yet"
    return f"{when}\n{rate}"


def _draw_goals(above: Axes, side: Axes, goals: StateArray, workspace: WorkspaceConfig) -> None:
    start, goal, solved = goals[:, :3], goals[:, 3:6], goals[:, 6] > 0.5
    # one scatter in the order of play: drawn per outcome, the later one would hide the earlier
    size, alpha = (9, 0.45) if len(goals) > 600 else (16, 0.65)
    dots: dict[str, Any] = {"s": size, "alpha": alpha, "c": np.where(solved, BLUE, ORANGE), "linewidths": 0}
    _draw_outline(above, workspace)
    above.scatter(goal[:, 0], goal[:, 1], **dots)
    style_axes(side)
    side.scatter(np.linalg.norm(goal[:, :2] - start[:, :2], axis=1), goal[:, 2], **dots)
    side.axhline(workspace.height_m, color=INK, linewidth=1.0, linestyle=_EDGE_STYLE)
    side.set_box_aspect(1.0)
    side.set_ylim(0.0, workspace.height_m * 1.08)
    side.set_xlabel("distance along the table (m)", color=FAINT)


def _draw_outline(axes: Axes, workspace: WorkspaceConfig) -> None:
    """Set ``axes`` up as a view from above, with the edge of the workspace dashed."""
    low, high = np.array(workspace.lower_m), np.array(workspace.upper_m)
    style_axes(axes)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    axes.plot(*(low[:2] + corners * (high - low)[:2]).T, color=INK, linewidth=1.0, linestyle=_EDGE_STYLE)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(low[0] - _MARGIN_M, high[0] + _MARGIN_M)
    axes.set_ylim(low[1] - _MARGIN_M, high[1] + _MARGIN_M)
    axes.set_xlabel("x (m), away from the robot", color=FAINT)


# --- coverage --------------------------------------------------------------------------------------------------------

_MOVED_M = 0.05


def plot_coverage(
    paths: StateArray, workspace: WorkspaceConfig, path: Path, title: str, *, of: str = "composition"
) -> Path:
    """Draw the paper's figure of a skill set: where random compositions, or random skills, take the object.

    Args:
        paths: (M, T, 3) object positions in metres in the world's frame, one row each.
        workspace: the box to draw; points more than a few centimetres outside it are left out.
        path: the PNG to write.
        title: whose they are, for example the primitives' name and version.
        of: one of them, as the title calls it.

    Raises:
        TandemError: the picture cannot be written.
    """
    figure = new_figure(14.0, 7.2, f"{title}, {_summary(paths, workspace, of)}")
    box = figure.add_axes((0.0, 0.0, 0.57, 0.95), projection="3d", computed_zorder=False)
    above = figure.add_axes((0.62, 0.1, 0.36, 0.74))
    draw_paths(box, above, paths, workspace)
    above.set_ylabel("y (m)", color=FAINT)
    above.set_title("From above; a dot is where the object ends", loc="left", fontsize=12, color=INK)
    return save(figure, path)


def draw_paths(box: Any, above: Axes, paths: StateArray, workspace: WorkspaceConfig) -> None:
    """Draw (M, T, 3) paths of the object in metres, one colour each, as ``plot_coverage`` does.

    Args:
        box: 3-D axes, made with ``computed_zorder=False``, for the workspace's box; None: the view from above alone.
        above: plain axes, for the view from above.
        paths: of the object.
        workspace: the box.
    """
    from matplotlib import colormaps

    _draw_outline(above, workspace)
    if box is not None:
        _draw_box(box, workspace)
    # The map's ends are nearly black, where neighbours no longer differ.
    for path, color in zip(paths, colormaps["turbo"](np.linspace(0.05, 0.95, len(paths))), strict=True):
        points = _inside(path, workspace)
        end = points[-1:] if np.isfinite(points[-1]).all() else points[:0]
        above.plot(*points[:, :2].T, color=color, linewidth=1.5)
        above.plot(*end[:, :2].T, color=color, marker="o", markersize=5, markeredgecolor="white")
        if box is not None:
            box.plot(*points.T, color=color, linewidth=1.5)
            box.plot(*end.T, color=color, marker="o", markersize=4.5)


def _inside(points: StateArray, workspace: WorkspaceConfig) -> StateArray:
    """``points`` with NaN, which breaks a line, where they leave the drawn surroundings of the workspace."""
    low, high = np.array(workspace.lower_m) - _MARGIN_M, np.array(workspace.upper_m) + _MARGIN_M
    near = (points >= low) & (points <= high)
    return np.where(near.all(axis=1, keepdims=True), points, np.nan)


def _summary(paths: StateArray, workspace: WorkspaceConfig, of: str) -> str:
    share = visited_share(paths, workspace)
    moved = (np.linalg.norm(paths - paths[:, :1], axis=2) > _MOVED_M).any(axis=1).sum()
    return f"{share:.0%} of the table's cells visited: {counted(len(paths), of)}, {moved} move the object over 5 cm"


def _draw_box(axes: Any, workspace: WorkspaceConfig) -> None:
    low, high = workspace.lower_m, workspace.upper_m
    for edge in combinations(np.array(list(product(*zip(low, high, strict=True)))), 2):
        if np.sum(edge[0] != edge[1]) == 1:
            axes.plot(*np.transpose(edge), color="#666666", linewidth=1.0, linestyle=_EDGE_STYLE)
    x, y = (np.array([low[axis] - _MARGIN_M, high[axis] + _MARGIN_M]) for axis in (0, 1))
    axes.plot_surface(*np.meshgrid(x, y), np.zeros((2, 2)), color="#d9c7a7", alpha=0.35, shade=False, zorder=0)
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", xlim=x, ylim=y, zlim=(0.0, high[2]))
    axes.set_box_aspect((np.ptp(x), np.ptp(y), high[2]), zoom=1.05)
    axes.view_init(elev=22, azim=-58)
    axes.tick_params(colors="#555555", labelsize=8)
    axes.locator_params(nbins=5)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.pane.fill = False
        axis._axinfo["grid"]["color"] = "#ececec"
