"""Pictures and tables of ``docs/results``, from the recorded files beside them.

    python benchmarks/figures.py pretraining --runs docs/results/runs/*.json --out docs/results

draws ``pretraining.png``, the learning curves of all runs (thin: a run, thick: their mean) over the levels that the
project asks of 3 million steps, and for each run where its goals were, and replaces the table between the markers in
``pretraining.md``.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from benchmarks.record_run import FORMAT_VERSION, unthin
from service.config import parse_config
from service.errors import TandemError
from service.registry.files import os_errors, write_atomic
from service.runtime.plots import plot_goals
from service.runtime.plots.figures import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    Array,
    column,
    counted,
    new_figure,
    save,
    style_axes,
)
from service.runtime.records import JsonlWriter
from service.runtime.rundir import RunDirectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BEGIN, END = "<!-- pretraining: begin, written by benchmarks/figures.py -->", "<!-- pretraining: end -->"
MIN_SHARE = 0.02
NUM_BINS = 40
"""Of env steps; a curve shows the mean in each."""
TABLE_BINS = 10
"""Of env steps; the table shows the last, and of the distance the first as well."""

_PAGE = f"# Pre-training\n\n![Learning curves](pretraining.png)\n\n{BEGIN}\n{END}\n"
_HEAD = ("run", "env steps", "minutes", "valid goals", "in the air", "Bob on them", "goal distance",
         "table, ever", "table, last", "air, last")  # fmt: skip
_ASKED = ("asked", "3.0 M", "", ">= 55 %", "", ">= 45 %", "grows", ">= 30 %", ">= 25 %", "")

Run = dict[str, Any]
Records = list[dict[str, Any]]


class _Curve(NamedTuple):
    key: str
    label: str
    color: str
    level: float | None = None
    """What is asked of it after 3 million steps."""
    share_key: str | None = None
    """Not drawn where this is under ``MIN_SHARE``: a rate over next to no goals is noise."""


_PANELS: dict[str, tuple[_Curve, ...]] = {
    "Alice's goals": (
        _Curve("alice/valid_fraction", "valid", BLUE, 0.55),
        _Curve("alice/lifted_fraction", "of those, in the air", ORANGE),
    ),
    "Bob on Alice's goals": (
        _Curve("bob/success_rate", "all", BLUE, 0.45),
        _Curve("bob/success_rate_air", "in the air", ORANGE, share_key="alice/lifted_fraction"),
    ),
    "How far Alice's goals are (m)": (
        _Curve("alice/goal_distance_m", "distance", BLUE),
        _Curve("alice/goal_height_p90_m", "height, 9 of 10 below", ORANGE),
    ),
    "Bob on random goals on the table": (
        _Curve("evaluation/table_success_ever", "within 5 cm at some time", GREEN, 0.30),
        _Curve("evaluation/table_success_last", "at the last step", BLUE, 0.25),
    ),
    "Bob on random goals in the air": (
        _Curve("evaluation/air_success_ever", "within 5 cm at some time", GREEN),
        _Curve("evaluation/air_success_last", "at the last step", BLUE),
    ),
    "Entropy of the policies (nats)": (
        _Curve("learner/alice_entropy", "Alice", ORANGE),
        _Curve("learner/bob_entropy", "Bob", BLUE),
    ),
}


def read_run(path: Path) -> Run:
    """A file that ``record_run.py`` made.

    Raises:
        TandemError: it cannot be read, or is of another format.
    """
    try:
        run = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise TandemError(f"cannot read {path}: {error}; make it with benchmarks/record_run.py") from error
    found = run.get("format_version") if isinstance(run, dict) else None
    if found != FORMAT_VERSION:
        raise TandemError(f"{path}: format version {found!r}, this program reads {FORMAT_VERSION}; record the run anew")
    return dict(run)


def draw_pretraining(runs: Sequence[Run], path: Path) -> Path:
    """Draw the learning curves of all runs into one picture."""
    records = [unthin(run["series"]) for run in runs]
    end = max(float(np.nanmax(column(each, "env_steps"))) for each in records)
    title = f"Pre-training from scratch: {counted(len(runs), 'run')}, {end / 1e6:.1f} M env steps"
    figure = new_figure(14.0, 7.8, title)
    figure.text(0.98, 0.955, "dotted: asked of 3 M env steps", ha="right", va="center", color=FAINT)
    for place, (axes, name) in enumerate(zip(figure.subplots(2, 3).flat, _PANELS, strict=True)):
        style_axes(axes)
        axes.set_title(name, loc="left", fontsize=12, weight="bold", color=INK)
        axes.set_xlabel("million env steps" if place >= 3 else "", color=FAINT)
        for curve in _PANELS[name]:
            _draw_curve(axes, curve, [_points(each, curve, end) for each in records], end / 1e6)
        axes.set_xlim(0.0, end / 1e6)
        if "(" not in name:  # a rate
            axes.set_ylim(0.0, 1.0)
        axes.legend(loc="best", frameon=False, fontsize=9.5)
    figure.subplots_adjust(left=0.05, right=0.98, top=0.87, bottom=0.08, wspace=0.18, hspace=0.3)
    return save(figure, path)


def _points(records: Records, curve: _Curve, end: float) -> Array:
    values = binned(records, curve.key, end)
    if curve.share_key is not None:
        enough = binned(records, curve.share_key, end) >= MIN_SHARE
        values = np.where(enough, values, np.nan)
    return values


def _draw_curve(axes: Axes, curve: _Curve, curves: Sequence[Array], end_m: float) -> None:
    """Every run thin and their mean thick, up to ``end_m`` million env steps."""
    middle = (np.arange(NUM_BINS) + 0.5) / NUM_BINS * end_m
    lines = np.stack([_joined(middle, each) for each in curves])
    if len(lines) > 1:
        axes.plot(middle, lines.T, color=curve.color, linewidth=0.8, alpha=0.4)
    axes.plot(middle, lines.mean(axis=0), color=curve.color, linewidth=2.2, label=curve.label)
    if curve.level is not None:
        axes.axhline(curve.level, color=curve.color, linewidth=1.0, linestyle=(0, (2, 3)))


def _joined(x: Array, y: Array) -> Array:
    """``y`` with straight lines over its gaps, but NaN before its first value and after its last."""
    known = np.isfinite(y)
    return np.interp(x, x[known], y[known], left=np.nan, right=np.nan) if known.any() else y


def binned(records: Records, key: str, end: float, num_bins: int = NUM_BINS) -> Array:
    """Means of a metric in ``num_bins`` equal spans of env steps up to ``end``, NaN where a span has none."""
    steps, values = column(records, "env_steps"), column(records, key)
    known = np.isfinite(values) & np.isfinite(steps)
    index = np.minimum((steps[known] / end * num_bins).astype(int), num_bins - 1)
    with np.errstate(invalid="ignore"):  # 0 / 0 where a span has none
        return np.bincount(index, values[known], num_bins) / np.bincount(index, minlength=num_bins)


def draw_goals(run: Run, path: Path) -> Path:
    """Draw where a run's goals were, over time."""
    config = parse_config(run["config"], where=str(run["name"]))
    with tempfile.TemporaryDirectory() as scratch:
        directory = Path(scratch) / run["name"]  # the picture's title names it
        goals = JsonlWriter(RunDirectory(directory).goals_file)
        for record in run["goals"]:
            goals.append(record)
        picture = plot_goals(directory, config.world.workspace).read_bytes()
    with os_errors("write", path):
        write_atomic(path, picture)
    return path


def pretraining_table(runs: Sequence[Run]) -> str:
    """Markdown: what is asked, a row for each run, and what a policy that does nothing gets."""
    rows = [_HEAD, ("---",) * len(_HEAD), _ASKED, *(_row(run) for run in runs)]
    idle = next((cells for run in runs if any(cells := _success(run["evaluations"], idle=True))), None)
    if idle is not None:
        rows.append(("idle policy", *[""] * 6, *idle))
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _row(run: Run) -> tuple[str, ...]:
    records = unthin(run["series"])
    end = records[-1]["env_steps"]

    def share(key: str) -> str:
        return _percent(binned(records, key, end, num_bins=TABLE_BINS)[-1])

    distance = 100 * binned(records, "alice/goal_distance_m", end, num_bins=TABLE_BINS)
    return (
        str(run["name"]),
        f"{end / 1e6:.1f} M",
        f"{records[-1]['time/wall_s'] / 60:.0f}",
        share("alice/valid_fraction"),
        share("alice/lifted_fraction"),
        share("bob/success_rate"),
        f"{distance[0]:.1f} to {distance[-1]:.1f} cm",
        *_success(run["evaluations"]),
    )


def _success(evaluations: Records, *, idle: bool = False) -> tuple[str, str, str]:
    """The cells of the evaluations recorded with a run; the interval is the 95 % one of Wilson."""
    rows = {row["goals"]: row for row in evaluations if (row["policy"] == "idle") == idle}

    def last(kind: str) -> str:
        low, high = (100 * rows[kind][f"success_last_{end}"] for end in ("low", "high"))
        return f"{_percent(rows[kind]['success_last'])} [{low:.0f}, {high:.0f}]"

    return (
        _percent(rows["table"]["success_ever"]) if "table" in rows else "",
        last("table") if "table" in rows else "",
        last("air") if "air" in rows else "",
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if np.isfinite(share) else ""


def replace_table(page: str, text: str) -> str:
    """``page`` with ``text`` between its markers.

    Raises:
        TandemError: it has not both markers.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise TandemError(f"no markers for the table: the page needs a line {BEGIN} and a line {END}")
    return f"{before}{begin}\n\n{text}\n\n{end}{after}"


def pretraining(run_files: Sequence[Path], out: Path) -> list[Path]:
    """Everything about pre-training: the curves, each run's goals, and the table in ``pretraining.md``.

    Returns:
        The files written.

    Raises:
        TandemError: a run or the page cannot be read, or something cannot be written.
    """
    runs = [read_run(path) for path in run_files]
    page_file = out / "pretraining.md"
    with os_errors("read", page_file):
        page = page_file.read_text(encoding="utf-8") if page_file.exists() else _PAGE
    page = replace_table(page, pretraining_table(runs))
    pictures = [draw_pretraining(runs, out / "pretraining.png")]
    pictures += [draw_goals(run, out / f"pretraining-goals-{run['name']}.png") for run in runs]
    with os_errors("write", page_file):
        write_atomic(page_file, page.encode())
    return [page_file, *pictures]


def main() -> int:
    """Parse the command line, draw, say what was written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", choices=("pretraining",))
    parser.add_argument("--runs", type=Path, metavar="FILE", nargs="+", required=True, help="of record_run.py")
    parser.add_argument("--out", type=Path, metavar="DIR", required=True, help="where pictures and page go")
    given = parser.parse_args()
    try:
        files = pretraining(given.runs, given.out)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print("\n".join(map(str, files)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
