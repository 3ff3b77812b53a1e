"""Common parts of all pictures: figure, axes, colours, reading records and saving.

A ``Figure`` is made without pyplot, so no window system and no global state is needed. Colours are Okabe and Ito's,
which colour-blind readers tell apart.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from service.base.errors import TandemError
from service.base.files import write_atomic
from service.base.jsonl import read_jsonl
from service.base.types import StateArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"
INK, FAINT = "#222222", "#777777"


def read_records(path: Path) -> list[dict[str, Any]]:
    """The records of ``path``.

    Raises:
        TandemError: the file is missing, damaged, or holds no record yet.
    """
    records = read_jsonl(path)
    if not records:
        raise TandemError(f"{path} holds no record yet; wait for the run's first iteration and draw again")
    return records


def column(records: Sequence[dict[str, Any]], key: str) -> StateArray:
    """The values of ``key``, NaN where a record lacks it or its value is not finite, (len(records),)."""
    values = [record.get(key) for record in records]
    return np.array([v if isinstance(v, (int, float)) and math.isfinite(v) else np.nan for v in values], dtype=float)


def new_figure(width: float, height: float, title: str) -> Figure:
    """An empty figure of ``width`` by ``height`` hundred pixels with its title at the top left."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100, facecolor="white")
    figure.text(0.02, 0.955, title, fontsize=15, weight="bold", color=INK, va="center")
    return figure


def save(figure: Figure, path: Path) -> Path:
    """Write ``figure`` as a PNG that takes its name only when it is whole; gives ``path`` back.

    Raises:
        TandemError: the disk is full or the file cannot be written.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_atomic(path, buffer.getvalue())
    return path


def style_axes(axes: Axes) -> None:
    """Two quiet axis lines, small ticks, a faint grid behind the data."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#bbbbbb")
    axes.tick_params(colors="#555555", labelsize=9, length=3)
    axes.grid(True, color="#ececec", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.locator_params(nbins=5)


def counted(number: int, noun: str) -> str:
    """``number`` and ``noun``, with the plural's s where it belongs."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
