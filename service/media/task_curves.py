"""Learning curves of one training."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service.media.figures import BLUE, FAINT, GREEN, column, new_figure, read_records, save, style_axes


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
        ("entropy coefficient", ("learner/entropy_coefficient",)),
    )
    for axes, (title, keys) in zip(figure.subplots(1, 3), panels, strict=True):
        for key, colour in zip(keys, (BLUE, GREEN, FAINT), strict=False):
            values = column(records, key)
            known = np.isfinite(values)
            axes.plot(steps[known], values[known], color=colour, linewidth=1.4, label=key)
        style_axes(axes)
        axes.set_title(title, loc="left", fontsize=11)
        axes.set_xlabel("env steps, thousands", color=FAINT, fontsize=9)
        axes.legend(fontsize=8, frameon=False)
    figure.subplots_adjust(left=0.06, right=0.98, top=0.82, bottom=0.15)
    return save(figure, path / "curves.png")
