"""Metrics in columns: means and extremes computed by hand, incremental reading, resumed runs, a bound in memory."""

import math
from datetime import UTC, datetime

import msgspec
import numpy as np
import pytest

from service.base.files import write_atomic
from service.status import series as status_series
from service.status.schemas import SeriesSet
from service.status.series import history, series, table
from service.store import disk_reader
from service.store.disk_reader import DiskReader
from tests.status.runs import append, record, write_status

STARTED = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture
def root(tmp_path):
    write_status(tmp_path, "cube", started=STARTED)
    return tmp_path


def ask(reader, names=("x",), after=0, points=1000, run_id="cube"):
    return history(reader, run_id, names, after, points)


def curves(reader, run_ids=("cube",), names=("x",), axis="env_steps", start=None, end=None, points=1000):
    found = series(reader, run_ids, names, axis, start, end, points)
    return SeriesSet.model_validate_json(msgspec.json.encode(found)).runs


def test_a_point_is_the_mean_of_its_iterations(root):
    append(root, "cube", *(record(i, x=value) for i, value in enumerate((1, 2, None, 6, 10, 20, 60), start=1)))
    answer = ask(DiskReader(root), points=3)
    # seven iterations in three parts begin at 0, 2 and 4
    assert answer.iteration == (2, 4, 7)
    assert answer.env_steps == (2000, 4000, 7000)
    assert answer.metrics == {"x": (1.5, 6.0, 30.0)}
    assert (answer.num_iterations, answer.last_iteration) == (7, 7)


def test_a_point_without_a_number(root):
    append(root, "cube", *(record(i, x=value) for i, value in enumerate((1, 3, None, None), start=1)))
    assert ask(DiskReader(root), points=2).metrics == {"x": (2.0, None)}


def test_a_metric_that_comes_later_and_goes_again(root):
    append(root, "cube", record(1), record(2, x=0.25), record(3))
    assert ask(DiskReader(root)).metrics == {"x": (None, 0.25, None)}


@pytest.mark.parametrize(("after", "iterations"), [(0, (1, 2, 3)), (2, (3,)), (3, ()), (99, ())])
def test_after_an_iteration(root, after, iterations):
    append(root, "cube", *(record(i, x=i) for i in (1, 2, 3)))
    answer = ask(DiskReader(root), after=after)
    assert (answer.iteration, answer.num_iterations, answer.last_iteration) == (iterations, len(iterations), 3)
    assert answer.metrics == {"x": iterations}


@pytest.mark.parametrize("seen", [True, False])
def test_a_history_that_was_cut_and_grew_again(root, seen):
    reader = DiskReader(root)
    append(root, "cube", *(record(i, x=i) for i in (1, 2, 3, 4)))
    ask(reader)
    path = root / "cube" / "metrics.jsonl"
    write_atomic(path, b"".join(path.read_bytes().splitlines(keepends=True)[:2]))
    if seen:
        assert ask(reader).metrics == {"x": (1, 2)}
    else:
        write_status(root, "cube", started=datetime(2026, 1, 2, tzinfo=UTC))
    append(root, "cube", *(record(i, x=10 * i) for i in (3, 4, 5)))
    assert ask(reader).metrics == {"x": (1, 2, 30, 40, 50)}


def bytes_read():
    """Of files, by this process; /proc's own text is small."""
    with open("/proc/self/io") as file:
        return int(file.readline().removeprefix("rchar:"))


def test_a_metric_that_is_asked_for_later(root):
    reader = DiskReader(root)
    rows = [record(i, x=i, **({"rare": i} if i == 50 else {}), y=None if i == 7 else -i) for i in range(1, 101)]
    append(root, "cube", *rows)
    assert ask(reader, names=["x"]).metrics["x"][6] == 7
    append(root, "cube", record(101, x=math.nan, y=3), record(60, y=5))  # the last one goes back to iteration 60
    found = ask(reader, names=None)
    assert found.iteration[-2:] == (59, 60)
    assert (found.metrics["y"][6], found.metrics["y"][-1], found.metrics["x"][-1]) == (None, 5, None)
    assert found.metrics["rare"] == (*[None] * 49, 50, *[None] * 10)


def test_points_have_the_extremes_of_their_iterations(root):
    append(root, "cube", *(record(i, x=9 if i == 77 else -9 if i == 5 else i % 2) for i in range(1, 401)))
    (run,) = curves(DiskReader(root), points=40)
    curve = run.curves["x"]
    assert len(run.x) == len(curve.mean) == len(curve.low) == len(curve.high) == 20
    assert (min(curve.low), max(curve.high)) == (-9, 9)
    assert curve.mean[10:] == (0.5,) * 10
    assert (run.x[0], run.x[-1], run.num_iterations) == (20_000, 400_000, 400)


def test_a_part_is_asked_for_anew(root):
    append(root, "cube", *(record(i, x=i, **{"time/wall_s": 2.0 * i}) for i in range(1, 401)))
    reader = DiskReader(root)
    (run,) = curves(reader, start=100_500, end=110_000, points=40)
    assert run.x == tuple(range(100_000, 112_000, 1000))  # one further on each side
    assert run.curves["x"].mean == tuple(range(100, 112))
    assert run.curves["x"].low is None
    assert curves(reader, axis="iteration", start=399.0)[0].x == (398, 399, 400)
    assert curves(reader, axis="wall_s", end=4.0)[0].x == (2, 4, 6)
    assert curves(reader, start=1e9)[0].x == (400_000,)


def test_a_run_that_is_gone_does_not_hide_the_others(root):
    append(root, "cube", record(1, x=1.23456789))
    gone, cube = curves(DiskReader(root), ("gone", "cube"), ("x", "no/such"))
    assert "no run 'gone'" in gone.problem
    assert (cube.problem, cube.curves.keys(), cube.curves["x"].mean) == (None, {"x"}, (1.23457,))  # six digits
    assert list(table(DiskReader(root), ("gone", "cube"), ("x", "y"))) == [
        "run,iteration,env_steps,x,y\n",
        "cube,1,1000,1.23456789,\n",
    ]


def test_many_curves_have_fewer_points(root, monkeypatch):
    monkeypatch.setattr(status_series, "MAX_NUMBERS", 10_000)
    append(root, "cube", *(record(i, x=i) for i in range(1, 401)))
    found = series(DiskReader(root), ["cube"] * 20, ["x"] * 10, "env_steps", None, None, 10_000)
    assert len(found["runs"][0]["x"]) == 25  # 10,000 numbers in all: 50 for each curve, the lowest and the highest


def test_a_sample_reads_little(root):
    append(root, "cube", *(record(i, x=i, pad="-" * 500) for i in range(1, 2001)))
    path = root / "cube" / "metrics.jsonl"
    before = bytes_read()
    found = DiskReader(root).sample("cube", "x", 20)
    assert bytes_read() - before < path.stat().st_size
    assert (found[0], found[-1]) == (1, 2000)
    assert np.all(np.diff(found) > 0)
    assert 15 <= len(found) <= 21


def test_a_sample_of_few_records_has_each_once(root):
    append(root, "cube", record(1, x=1), record(2), record(3, x=3))
    reader = DiskReader(root)
    assert reader.sample("cube", "x", 40) == [1, None, 3]
    ask(reader)  # now it is in memory
    assert reader.sample("cube", "x", 40) == [1, None, 3]


def test_memory_is_bounded(root, monkeypatch):
    num_columns = len(record(1, x=1))
    monkeypatch.setattr(disk_reader, "MAX_COLUMN_BYTES", 2 * 8 * 100 * num_columns)
    reader = DiskReader(root)
    for run_id in ("a", "b", "c"):
        write_status(root, run_id, started=STARTED)
        append(root, run_id, *(record(i, x=i) for i in range(1, 101)))
        assert len(ask(reader, run_id=run_id).metrics["x"]) == 100
    kept = [path.name for path, records in reader._records.items() if records.num_bytes]
    assert sorted(kept) == ["b", "c"]
    assert ask(reader, run_id="a").metrics["x"][99] == 100
