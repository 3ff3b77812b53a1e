"""Plot of where random compositions of the primitives take the object: the paper's figure of a skill set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from service.actors.coverage import visited_share
from service.config import WorkspaceConfig
from service.media.plots.figures import (
    EDGE_STYLE,
    FAINT,
    INK,
    MARGIN_M,
    counted,
    draw_outline,
    new_figure,
    save,
)
from service.types import StateArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOVED_M = 0.05


def plot_coverage(trajectories: StateArray, workspace: WorkspaceConfig, path: Path, title: str) -> Path:
    """Draw where random compositions take the object, one colour each: in the workspace's box, and from above.

    Args:
        trajectories: (M, T, 3) object positions in metres in the world's frame, one row per composition.
        workspace: the box to draw; points more than a few centimetres outside it are left out.
        path: the PNG to write.
        title: whose compositions these are, for example the primitives' name and version.

    Raises:
        TandemError: the picture cannot be written.
    """
    figure = new_figure(14.0, 7.2, f"{title}, {_summary(trajectories, workspace)}")
    box = figure.add_axes((0.0, 0.0, 0.57, 0.95), projection="3d", computed_zorder=False)
    above = figure.add_axes((0.62, 0.1, 0.36, 0.74))
    draw_paths(box, above, trajectories, workspace)
    above.set_ylabel("y (m)", color=FAINT)
    above.set_title("From above; a dot is where the object ends", loc="left", fontsize=12, color=INK)
    return save(figure, path)


def draw_paths(box: Any, above: Axes, paths: StateArray, workspace: WorkspaceConfig) -> None:
    """Draw paths of the object, one colour each: in the workspace's box, and from above.

    Args:
        box: 3-D axes, made with ``computed_zorder=False``.
        above: plain axes.
        paths: (M, T, 3) metres; points more than a few centimetres outside the workspace are left out.
        workspace: the box.
    """
    from matplotlib import colormaps

    _draw_box(box, workspace)
    draw_outline(above, workspace)
    # the map's ends are nearly black, where neighbours no longer differ
    for points, color in zip(paths, colormaps["turbo"](np.linspace(0.05, 0.95, len(paths))), strict=True):
        _draw_trajectory(box, above, _inside(points, workspace), color)


def _inside(points: StateArray, workspace: WorkspaceConfig) -> StateArray:
    """``points`` with NaN, which breaks a line, where they leave the drawn surroundings of the workspace."""
    low, high = np.array(workspace.lower_m) - MARGIN_M, np.array(workspace.upper_m) + MARGIN_M
    near = (points >= low) & (points <= high)
    return np.where(near.all(axis=1, keepdims=True), points, np.nan)


def _summary(trajectories: StateArray, workspace: WorkspaceConfig) -> str:
    share = visited_share(trajectories, workspace)
    moved = (np.linalg.norm(trajectories - trajectories[:, :1], axis=2) > _MOVED_M).any(axis=1).sum()
    compositions = counted(len(trajectories), "composition")
    return f"{share:.0%} of the table's cells visited: {compositions}, {moved} move the object over 5 cm"


def _draw_box(axes: Any, workspace: WorkspaceConfig) -> None:
    low, high = workspace.lower_m, workspace.upper_m
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, -1).T
    for first in range(8):
        for second in (first ^ 1, first ^ 2, first ^ 4):
            if second > first:
                axes.plot(*corners[[first, second]].T, color="#666666", linewidth=1.0, linestyle=EDGE_STYLE)
    x, y = (np.array([low[axis] - MARGIN_M, high[axis] + MARGIN_M]) for axis in (0, 1))
    axes.plot_surface(*np.meshgrid(x, y), np.zeros((2, 2)), color="#d9c7a7", alpha=0.35, shade=False, zorder=0)
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", xlim=x, ylim=y, zlim=(0.0, high[2]))
    axes.set_box_aspect((np.ptp(x), np.ptp(y), high[2]), zoom=1.05)
    axes.view_init(elev=22, azim=-58)
    axes.tick_params(colors="#555555", labelsize=8)
    axes.locator_params(nbins=5)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.pane.fill = False
        axis._axinfo["grid"]["color"] = "#ececec"


def _draw_trajectory(box: Any, above: Axes, points: StateArray, color: Any) -> None:
    box.plot(*points.T, color=color, linewidth=1.5)
    above.plot(points[:, 0], points[:, 1], color=color, linewidth=1.5)
    if np.isfinite(points[-1]).all():
        box.plot(*points[-1:].T, color=color, marker="o", markersize=4.5)
        above.plot(*points[-1:, :2].T, color=color, marker="o", markersize=5, markeredgecolor="white")
