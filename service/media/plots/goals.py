"""Plot of Alice's goals over time, and which of them Bob solves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from service.config import WorkspaceConfig
from service.errors import TandemError
from service.media.plots.figures import (
    BLUE,
    EDGE_STYLE,
    FAINT,
    INK,
    ORANGE,
    column,
    counted,
    draw_outline,
    new_figure,
    read_records,
    save,
    style_axes,
)
from service.types import StateArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GOALS_FILE = "goals.jsonl"
GOALS_PICTURE = "goals.png"
_NUM_SLICES = 4


def plot_goals(run_dir: Path, workspace: WorkspaceConfig) -> Path:
    """Draw ``goals.png`` from the run's ``goals.jsonl``: where valid goals are, in four slices of time, solved or not.

    The top row looks from above, with the workspace's outline; the bottom row shows how far a goal is from where the
    object started and how high it is above the table.

    Raises:
        TandemError: the run has no goals yet, they are damaged, or the picture cannot be written.
    """
    path = run_dir / GOALS_FILE
    records = read_records(path)
    figure = new_figure(14.0, 7.8, f"{run_dir.resolve().name}: where Alice's goals are, and which of them Bob solves")
    columns = figure.subplots(2, _NUM_SLICES, sharex="row", sharey="row").T
    for (above, side), slice_ in zip(columns, np.array_split(np.arange(len(records)), _NUM_SLICES), strict=True):
        chosen = [records[index] for index in slice_]
        goals = _goals(chosen, path)
        _draw_goals(above, side, goals, workspace)
        above.set_title(_slice_title(chosen, goals), loc="left", fontsize=11, color=INK)
    columns[0][1].set_xlim(left=0.0)
    columns[0][0].set_ylabel("from above: y (m)", color=INK)
    columns[0][1].set_ylabel("height above the table (m)", color=INK)
    _goal_legend(figure)
    figure.subplots_adjust(left=0.055, right=0.985, top=0.83, bottom=0.075, wspace=0.08, hspace=0.22)
    return save(figure, run_dir / GOALS_PICTURE)


def _goals(records: Sequence[dict[str, Any]], path: Path) -> StateArray:
    """The records' goals, (number, 7): start xyz, goal xyz, solved; any that is not finite is left out."""
    try:
        rows = [row for record in records for row in record.get("goals") or ()]
        goals = np.array(rows, dtype=np.float64).reshape(len(rows), 7)
    except (TypeError, ValueError) as error:
        raise TandemError(
            f"{path}: a goal is not 7 numbers (start xyz, goal xyz, solved): {error}; remove its line and draw again"
        ) from error
    return goals[np.isfinite(goals).all(axis=1)]


def _slice_title(records: Sequence[dict[str, Any]], goals: StateArray) -> str:
    steps = column(records, "env_steps") / 1e6
    when = f"{np.nanmin(steps):.2f} to {np.nanmax(steps):.2f} M env steps" if np.isfinite(steps).any() else ""
    rate = f"{counted(len(goals), 'goal')}, {goals[:, 6].mean():.0%} solved" if len(goals) else "no goals yet"
    return f"{when}\n{rate}"


def _draw_goals(above: Axes, side: Axes, goals: StateArray, workspace: WorkspaceConfig) -> None:
    start, goal, solved = goals[:, :3], goals[:, 3:6], goals[:, 6] > 0.5
    # one scatter in the order of play: drawn per outcome, the later one would hide the earlier
    colors = np.where(solved, BLUE, ORANGE)
    size, alpha = (9, 0.45) if len(goals) > 600 else (16, 0.65)
    draw_outline(above, workspace)
    above.scatter(goal[:, 0], goal[:, 1], s=size, c=colors, alpha=alpha, linewidths=0)
    distance = np.linalg.norm(goal[:, :2] - start[:, :2], axis=1)
    style_axes(side)
    side.scatter(distance, goal[:, 2], s=size, c=colors, alpha=alpha, linewidths=0)
    side.axhline(workspace.height_m, color=INK, linewidth=1.0, linestyle=EDGE_STYLE)
    side.set_box_aspect(1.0)
    side.set_ylim(0.0, workspace.height_m * 1.08)
    side.set_xlabel("distance along the table (m)", color=FAINT)


def _goal_legend(figure: Figure) -> None:
    from matplotlib.lines import Line2D

    dots = {"solved by Bob": BLUE, "not solved": ORANGE}
    handles = [Line2D([], [], color=color, marker="o", linestyle="", label=label) for label, color in dots.items()]
    edge = Line2D([], [], color=INK, linestyle=EDGE_STYLE, linewidth=1.0, label="edge of the workspace")
    figure.legend(handles=[*handles, edge], loc="upper right", ncols=3, frameon=False, bbox_to_anchor=(0.99, 0.985))
