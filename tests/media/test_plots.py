"""Plots of a run: what they draw, and the numbers and words in them by hand."""

import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from service.base.errors import TandemError
from service.base.jsonl import JsonlWriter
from service.config import WorkspaceConfig
from service.media.figures import column, new_figure
from service.media.plots import (
    _Curve,
    _draw_panel,
    _goals,
    _inside,
    _Panel,
    _slice_title,
    _smooth,
    _summary,
    plot_coverage,
    plot_curves,
    plot_goals,
    plot_study,
)

# x and y from -0.1 to 0.1, z from 0 to 0.2: 4 x 4 x 4 cells of 5 cm
WORKSPACE = WorkspaceConfig(center_x_m=0.0, length_x_m=0.2, length_y_m=0.2, height_m=0.2)
GOAL = [0.0, 0.0, 0.025, 0.1, 0.0, 0.2, 1]


def _png_size(path):
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    return len(data), int.from_bytes(data[16:20], "big")


def _append(path, *records):
    for record in records:
        JsonlWriter(path).append(record)


def _metrics(iteration):
    wave = 0.5 + 0.4 * np.sin(iteration)
    keys = ("alice/valid_fraction", "bob/success_rate", "alice/goal_height_m", "skills/distance_m", "rollout/return")
    return {"iteration": iteration, "env_steps": iteration * 1000, "time/wall_s": iteration * 2.0} | dict.fromkeys(
        keys, wave
    )


@pytest.mark.parametrize("method", ["self-play", "distillation", "skills", "ours"])
def test_curves_are_drawn_1400_pixels_wide(tmp_path, method):
    _append(tmp_path / "metrics.jsonl", *map(_metrics, range(30)))
    path = plot_curves(tmp_path, method)
    size, width = _png_size(path)
    assert path == tmp_path / "curves.png"
    assert width == 1400
    assert size > 30_000
    assert sorted(file.name for file in tmp_path.iterdir()) == ["curves.png", "metrics.jsonl"]


def test_a_panel_names_its_curves_with_the_last_value_that_is_known():
    axes = new_figure(4.0, 4.0, "").subplots()
    curves = (_Curve("a", "one", "red"), _Curve("evaluation/b", "two", "blue"), _Curve("c", "three", "green"))
    records = [{"env_steps": 1e6, "a": 0.5}, {"env_steps": 2e6, "a": None, "evaluation/b": 0.25}, {"a": 0.75}]
    _draw_panel(axes, _Panel("Title", "grows", "solved"), [(curve, records) for curve in curves])
    assert {text.get_text() for text in axes.texts} == {"grows", "one 0.50", "two 0.25"}
    assert (axes.get_ylim(), axes.get_xlim()[0]) == ((0.0, 1.0), 0.0)


def test_the_runs_of_a_study_in_one_picture(tmp_path):
    runs = {f"seed {seed}": tmp_path / f"seed-{seed}" for seed in range(8)}
    picture = tmp_path / "curves.png"
    with pytest.raises(TandemError, match="no run in"):
        plot_study(runs, picture)
    _append(runs["seed 0"] / "metrics.jsonl", *map(_metrics, range(10)))
    before = plot_study(runs, picture).read_bytes()
    assert _png_size(picture)[1] == 1400
    for path in list(runs.values())[1:7]:  # more than there are colours; one has not begun
        _append(path / "metrics.jsonl", *map(_metrics, range(5)))
    several = plot_study(runs, picture).read_bytes()
    assert several != before
    _append(runs["seed 0"] / "metrics.jsonl", _metrics(10) | {"evaluation/mixed_success_last": 0.5})
    assert plot_study(runs, picture).read_bytes() != several


@pytest.mark.parametrize(
    "records",
    [
        [{"iteration": 0}],
        [_metrics(0)],
        [_metrics(1), {"iteration": 2, "bob/success_rate": 0.5}, _metrics(3) | {"alice/valid_fraction": float("nan")}],
    ],
)
@pytest.mark.filterwarnings("error")
def test_curves_bear_missing_values(tmp_path, records):
    _append(tmp_path / "metrics.jsonl", *records)
    assert _png_size(plot_curves(tmp_path))[0] > 20_000


@pytest.mark.parametrize(
    ("plot", "name"), [(plot_curves, "metrics.jsonl"), (partial(plot_goals, workspace=WORKSPACE), "goals.jsonl")]
)
def test_an_empty_or_missing_file_is_an_error_that_names_it(tmp_path, plot, name):
    with pytest.raises(TandemError, match=f"cannot read .*{name}"):
        plot(tmp_path)
    (tmp_path / name).write_text('{"torn')
    with pytest.raises(TandemError, match=f"{name} holds no record yet"):
        plot(tmp_path)


def test_column_has_nan_where_a_record_has_no_finite_number():
    records = [{"a": 1}, {}, {"a": None}, {"a": float("inf")}, {"a": "text"}, {"a": 0.5}]
    np.testing.assert_array_equal(column(records, "a"), [1.0, np.nan, np.nan, np.nan, np.nan, 0.5])


def test_smoothing_by_hand():
    # span 3: decay 1/2, so (0.5 * 1) / 0.5, (0.25 * 1 + 0.5 * 4) / 0.75, (0.125 * 1 + 0.25 * 4 + 0.5 * 0) / 0.875
    np.testing.assert_allclose(_smooth(np.array([1.0, 4.0, 0.0]), span=3.0), [1.0, 3.0, 1.125 / 0.875])
    np.testing.assert_allclose(_smooth(np.array([2.0, 5.0]), span=1.0), [2.0, 5.0])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("num_records", [1, 9])
def test_goals_are_drawn_for_short_and_long_runs(tmp_path, num_records):
    _append(
        tmp_path / "goals.jsonl",
        *({"iteration": i, "env_steps": 1000 * i, "goals": [GOAL] * (i % 3)} for i in range(num_records)),
    )
    path = plot_goals(tmp_path, WORKSPACE)
    assert path == tmp_path / "goals.png"
    assert _png_size(path)[0] > 20_000


def test_goals_of_many_records_are_joined_and_broken_ones_left_out():
    unsolved, broken = [*GOAL[:6], 0], [None, *GOAL[1:]]
    records = [{"env_steps": 1e6, "goals": [GOAL, unsolved]}, {}, {"env_steps": 3e6, "goals": [GOAL, broken, GOAL]}]
    goals = _goals(records)
    np.testing.assert_array_equal(goals, [GOAL, unsolved, GOAL, GOAL])
    assert _slice_title(records, goals) == "1.00 to 3.00 M env steps\n4 goals, 75% solved"
    assert _slice_title([], goals[:0]) == "\nno goals yet"


@pytest.mark.filterwarnings("error")
def test_coverage_is_drawn_also_for_trajectories_that_leave_or_stand_still(tmp_path):
    line = np.linspace([0.0, 0.0, 0.025], [0.05, 0.05, 0.15], 20)
    away = np.linspace([0.0, 0.0, 0.025], [2.0, 0.0, -1.0], 20)
    paths = np.stack([line, away, np.tile(line[:1], (20, 1)), 100.0 * away])
    path = plot_coverage(paths, WORKSPACE, tmp_path / "new" / "coverage.png", "v1")
    assert _png_size(path) == (pytest.approx(120_000, rel=0.7), 1400)


def test_coverage_counts_by_hand():
    still = np.full((3, 3), 0.01)
    moving = np.array([[0.01, 0.01, 0.01], [0.09, 0.01, 0.01], [5.0, 0.01, 0.01]])
    # One of 16 cells is entered, that of (0.09, 0.01); the one in which both start does not count.
    words = "6% of the table's cells visited: 2 compositions, 1 move the object over 5 cm"
    assert _summary(np.stack([still, moving]), WORKSPACE, "composition") == words


def test_points_far_outside_break_the_line():
    points = np.array([[0.0, 0.0, 0.1], [0.12, 0.0, 0.1], [0.14, 0.0, 0.1]])
    np.testing.assert_array_equal(np.isnan(_inside(points, WORKSPACE))[:, 0], [False, False, True])


def test_import_loads_no_matplotlib_and_drawing_no_pyplot():
    new_figure(1.0, 1.0, "")
    code = (
        "import sys, service.media.plots as p; assert 'matplotlib' not in sys.modules; "
        "from service.media.figures import new_figure; new_figure(1, 1, ''); "
        "assert 'matplotlib.pyplot' not in sys.modules and 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
