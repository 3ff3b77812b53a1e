"""Where random compositions take the object at three stages of a run, beside a random policy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.run_files import Run
from benchmarks.stages import CELL_SIZE_M, RANDOM, STAGES, mean_share, paths_m
from service.config import WorkspaceConfig
from service.media.plots.coverage import draw_paths
from service.media.plots.figures import FAINT, INK, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CELL_COLOR = "#e2e2e2"


def draw_coverage(run: Run, path: Path) -> Path:
    """Draw a column for the random policy and for each stage: in the workspace's box, and from above.

    Args:
        run: one that has a coverage.
        path: the PNG to write.
    """
    coverage, workspace = run["coverage"], WorkspaceConfig.model_validate(run["config"]["world"]["workspace"])
    stages = coverage["stages"]
    figure = new_figure(14.0, 8.4, f"{run['name']}: where random compositions of Bob's primitives take the object")
    words = f"{coverage['num_skills']} compositions of {coverage['num_steps']} steps; a dot is where the object ends"
    figure.text(0.98, 0.955, words, ha="right", va="center", color=FAINT)
    width = 0.98 / (1 + len(STAGES))
    for place, (name, stage) in enumerate(stages.items()):
        left = 0.015 + place * width
        box = figure.add_axes((left - 0.01, 0.47, width - 0.025, 0.4), projection="3d", computed_zorder=False)
        above = figure.add_axes((left + 0.035, 0.075, width - 0.05, 0.38))
        draw_paths(box, above, paths_m(stage), workspace)
        box.set(xlabel="", ylabel="", zlabel="")  # the view from above has them
        figure.text(left, 0.905, _words(name, stage, stages[RANDOM]), fontsize=11, color=INK, va="top")
        above.set_ylabel("y (m)" if place == 0 else "", color=FAINT)
        _draw_cells(above, workspace)
    return save(figure, path)


def _draw_cells(above: Axes, workspace: WorkspaceConfig) -> None:
    """The cells that are counted, as a grid."""
    low, high = workspace.lower_m, workspace.upper_m
    above.grid(False)
    x, y = (np.arange(low[axis], high[axis] + CELL_SIZE_M / 2, CELL_SIZE_M) for axis in (0, 1))
    above.vlines(x, low[1], high[1], color=CELL_COLOR, linewidth=0.8, zorder=0.5)
    above.hlines(y, low[0], high[0], color=CELL_COLOR, linewidth=0.8, zorder=0.5)


def _words(name: str, stage: dict[str, Any], random: dict[str, Any]) -> str:
    share = f"{mean_share(stage):.0%} of the table's cells"
    if name == RANDOM:
        return f"{name}\n{share}"
    when = f"{stage['env_steps'] / 1e6:.3g} M env steps" if stage["env_steps"] else "untrained"
    return f"{name}: {when}\n{share}, {mean_share(stage) / mean_share(random):.1f} x random"
