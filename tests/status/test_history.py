"""Metrics in columns: means computed by hand, incremental reading, and resumed runs."""

from datetime import UTC, datetime

import pytest
from service.status.history import HistoryCache

from service.io.files import write_atomic
from service.status import history
from service.store.disk_reader import DiskReader
from tests.status.runs import append, record, write_status

STARTED = datetime(2026, 1, 1, tzinfo=UTC)


class CountingReader(DiskReader):
    """A reader that counts the records it returns."""

    handed_out = 0

    def metrics(self, run_id, *, after_iteration=0):
        records = super().metrics(run_id, after_iteration=after_iteration)
        self.handed_out += len(records)
        return records


@pytest.fixture
def root(tmp_path):
    write_status(tmp_path, "cube", started=STARTED)
    return tmp_path


def ask(histories, names=("x",), after=0, points=1000, run_id="cube"):
    return histories.history(run_id, names, after, points)


def test_a_point_is_the_mean_of_its_iterations(root):
    append(root, "cube", *(record(i, x=value) for i, value in enumerate((1, 2, None, 6, 10, 20, 60), start=1)))
    answer = ask(HistoryCache(DiskReader(root)), points=3)
    # seven iterations in three parts begin at 0, 2 and 4
    assert answer.iteration == (2, 4, 7)
    assert answer.env_steps == (2000, 4000, 7000)
    assert answer.metrics == {"x": (1.5, 6.0, 30.0)}
    assert (answer.num_iterations, answer.last_iteration) == (7, 7)


def test_a_point_without_a_number(root):
    append(root, "cube", *(record(i, x=value) for i, value in enumerate((1, 3, None, None), start=1)))
    assert ask(HistoryCache(DiskReader(root)), points=2).metrics == {"x": (2.0, None)}


def test_a_metric_that_comes_later_and_goes_again(root):
    append(root, "cube", record(1), record(2, x=0.25), record(3))
    assert ask(HistoryCache(DiskReader(root))).metrics == {"x": (None, 0.25, None)}


@pytest.mark.parametrize(("after", "iterations"), [(0, (1, 2, 3)), (2, (3,)), (3, ()), (99, ())])
def test_after_an_iteration(root, after, iterations):
    append(root, "cube", *(record(i, x=i) for i in (1, 2, 3)))
    answer = ask(HistoryCache(DiskReader(root)), after=after)
    assert (answer.iteration, answer.num_iterations, answer.last_iteration) == (iterations, len(iterations), 3)
    assert answer.metrics == {"x": iterations}


def test_before_the_first_record(root):
    answer = ask(HistoryCache(DiskReader(root)), names=None)
    assert (answer.last_iteration, answer.iteration, answer.metrics, answer.names) == (0, (), {}, ())


def test_iteration_and_env_steps_are_columns_of_their_own(root):
    append(root, "cube", record(1, x=0.5))
    assert ask(HistoryCache(DiskReader(root)), names=["env_steps", "x", "x", "iteration"]).metrics == {"x": (0.5,)}


def test_only_what_is_new_is_read(root):
    reader = CountingReader(root)
    histories = HistoryCache(reader)
    append(root, "cube", *(record(i, x=i) for i in range(1, 101)))
    ask(histories)
    append(root, "cube", record(101, x=101))
    reader.handed_out = 0
    assert ask(histories, after=99).metrics == {"x": (100, 101)}
    assert reader.handed_out == 2  # the last one known, and the new one


def test_a_history_that_was_cut(root):
    histories = HistoryCache(DiskReader(root))
    append(root, "cube", *(record(i, x=i) for i in (1, 2, 3, 4)))
    ask(histories)
    path = root / "cube" / "metrics.jsonl"
    write_atomic(path, b"".join(path.read_bytes().splitlines(keepends=True)[:2]))
    assert ask(histories).metrics == {"x": (1, 2)}
    append(root, "cube", record(3, x=30))
    assert ask(histories).metrics == {"x": (1, 2, 30)}


def test_a_history_that_was_cut_and_grew_again_unseen(root):
    histories = HistoryCache(DiskReader(root))
    append(root, "cube", *(record(i, x=i) for i in (1, 2, 3, 4)))
    ask(histories)
    path = root / "cube" / "metrics.jsonl"
    write_atomic(path, b"".join(path.read_bytes().splitlines(keepends=True)[:2]))
    append(root, "cube", *(record(i, x=10 * i) for i in (3, 4, 5)))
    write_status(root, "cube", started=datetime(2026, 1, 2, tzinfo=UTC))
    assert ask(histories).metrics == {"x": (1, 2, 30, 40, 50)}


def test_few_runs_are_kept(root, monkeypatch):
    monkeypatch.setattr(history, "MAX_RUNS", 2)
    reader = CountingReader(root)
    histories = HistoryCache(reader)
    for run_id in ("a", "b", "c"):
        write_status(root, run_id, started=STARTED)
        append(root, run_id, record(1, x=1), record(2, x=2))
        ask(histories, run_id=run_id)
    reader.handed_out = 0
    assert ask(histories, run_id="c").metrics == {"x": (1, 2)}
    assert reader.handed_out == 1
    assert ask(histories, run_id="a").metrics == {"x": (1, 2)}
    assert reader.handed_out == 3
