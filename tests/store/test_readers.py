"""What both readers promise, on a disk and in a real Redis."""

import re
import threading

import pytest

from service.base.errors import DamagedStoreError, StoreUnavailableError, UnknownRunError
from service.base.jsonl import JsonlWriter
from service.base.lock import DirectoryLock
from service.store.address import run_key
from service.store.disk_reader import DiskReader
from service.store.models import SILENT_AFTER
from service.store.redis_reader import RedisReader
from service.store.run_directory import RunDirectory
from service.store.run_writer import RunWriter
from tests.runs.runs import assert_one_line
from tests.store.stores import a_grid, a_record, a_silent_status, a_status, a_writer, wait_until


class Disk:
    """A run directory as a run has it: a lock, a writer, and records that the run writes for itself."""

    def __init__(self, root):
        self.root = root
        self.reader = DiskReader(root)
        root.mkdir()

    def writer(self, run_id):
        directory = self.root / run_id
        lock, records = DirectoryLock(directory), JsonlWriter(directory / "metrics.jsonl")

        class Writer(RunWriter):
            def metrics(self, record):
                records.append(record)

            def close(self):
                super().close()
                lock.release()

        return Writer(RunDirectory(directory))

    def damage(self, run_id, what):
        (self.root / run_id / {"status": "status.json", "goals": "goals.json"}[what]).write_text('{"a": 1}')

    def damage_records(self, run_id):
        with (self.root / run_id / "metrics.jsonl").open("a") as file:
            file.write('\x00{]\n[1]\n{"iteration": "x"}\n')

    def lose(self):
        self.root.rename(self.root.with_name("lost"))


class InRedis:
    """A run in Redis."""

    def __init__(self, redis):
        self._redis = redis
        self.reader = RedisReader(redis.address)

    def writer(self, run_id):
        return a_writer(self._redis.address, run_id)

    def damage(self, run_id, what):
        self._redis.address.client(1.0).set(run_key(run_id, what), b'{"a": 1}')

    def damage_records(self, run_id):
        self._redis.address.client(1.0).zadd(
            run_key(run_id, "metrics"), {b"\x00{]": 3, b"[1]": 3, b'{"iteration": "x"}': 3}
        )

    def lose(self):
        self._redis.kill()


@pytest.fixture(params=["disk", "redis"])
def store(request, tmp_path):
    if request.param == "disk":
        return Disk(tmp_path / "runs")
    return InRedis(request.getfixturevalue("redis"))


def tell(store, run_id="cube", *, records=(), grid=None, **changes):
    """What a run told before it ended, or was killed."""
    writer = store.writer(run_id)
    writer.status(a_status(run_id, **changes))
    for record in records:
        writer.metrics(record)
    if grid is not None:
        writer.goals(grid)
    writer.close()


def test_it_reads_what_a_run_told(store):
    told = a_status(state="converged", iteration=7, published="panda-cube@3", last_error="none", warnings=("a", "b"))
    writer = store.writer("cube")
    writer.status(told)
    writer.metrics(a_record(1, nan=float("nan")))
    writer.goals(a_grid(0))  # before the first env step
    writer.goals(a_grid(2))
    writer.close()
    assert store.reader.run("cube") == told
    assert store.reader.runs() == [told]
    assert store.reader.metrics("cube") == [a_record(1, nan=None)]
    assert store.reader.goals("cube") == a_grid(2)
    store.reader.ready()


def test_records_after_an_iteration_and_nothing_yet(store):
    assert store.reader.runs() == []
    tell(store)
    assert store.reader.metrics("cube") == []
    assert store.reader.newest("cube") is None
    assert store.reader.sample("cube", "x", 5) == []
    assert store.reader.goals("cube") is None
    tell(store, records=[a_record(number) for number in range(1, 8)])
    assert [each["iteration"] for each in store.reader.metrics("cube", after_iteration=4)] == [5, 6, 7]
    assert store.reader.metrics("cube", after_iteration=7) == []
    assert store.reader.newest("cube") == a_record(7)


def test_metrics_in_columns_and_a_sample_of_one(store):
    tell(store, records=[a_record(number, x=None if number == 3 else number / 2) for number in range(1, 6)])
    found = store.reader.columns("cube", ["x", "no/such"])
    assert (found.iteration.tolist(), list(found.metrics)) == ([1, 2, 3, 4, 5], ["x"])
    assert found.metrics["x"].tolist() == pytest.approx([0.5, 1.0, float("nan"), 2.0, 2.5], nan_ok=True)
    assert set(store.reader.columns("cube", None).metrics) == set(found.names)
    sample = store.reader.sample("cube", "x", 5)
    assert (sample[0], sample[-1]) == (0.5, 2.5)
    assert None in sample
    assert store.reader.sample("cube", "no/such", 5) == [None] * len(sample)


def test_a_resumed_run_makes_its_last_iterations_again(store):
    """It has lost those after its last checkpoint; what it makes again takes their place."""
    tell(store, records=[a_record(number, past=0) for number in range(1, 8)])
    writer = store.writer("cube")
    assert len(store.reader.metrics("cube")) == 7
    assert store.reader.columns("cube", ["past"]).metrics["past"].tolist() == [0] * 7
    writer.metrics(a_record(5, past=1))
    wait_until(lambda: len(store.reader.metrics("cube")) == 5)
    writer.metrics(a_record(6, past=1))
    writer.metrics(a_record(6, past=2))
    writer.close()
    records = store.reader.metrics("cube")
    assert [(each["iteration"], each["past"]) for each in records] == [(1, 0), (2, 0), (3, 0), (4, 0), (5, 1), (6, 2)]
    assert store.reader.columns("cube", ["past"]).metrics["past"].tolist() == [0, 0, 0, 0, 1, 2]


def test_the_newest_start_comes_first_and_an_unknown_run_is_told_which_there_are(store):
    now, reader = a_status().started, store.reader
    for run_id, age in (("b", 1), ("a", 2)):
        tell(store, run_id, state="finished", started=now - age * SILENT_AFTER)
    assert [run.run_id for run in reader.runs()] == ["b", "a"]
    for ask in (reader.run, reader.metrics, reader.goals, reader.request_stop):
        for run_id in ("nobody", "../a", "", "x" * 5000):
            with pytest.raises(UnknownRunError) as error:
                ask(run_id)
            assert_one_line(error.value, "no run", "it holds: a, b")
            assert len(str(error.value)) < 400


def test_a_stop_request_reaches_the_run(store):
    writer = store.writer("cube")
    writer.status(a_status())
    wait_until(lambda: store.reader.runs() != [])
    assert not writer.stop_requested()
    assert not store.reader.run("cube").stopping
    store.reader.request_stop("cube")
    store.reader.request_stop("cube")
    assert store.reader.run("cube").stopping
    wait_until(writer.stop_requested)
    writer.status(a_status(state="interrupted"))
    writer.close()
    assert not store.reader.run("cube").stopping
    store.reader.request_stop("cube")  # it has ended: nothing happens
    again = store.writer("cube")  # the request was for the process that has ended
    again.status(a_status())
    wait_until(lambda: store.reader.run("cube").state == "running")
    assert not again.stop_requested()
    assert not store.reader.run("cube").stopping
    again.close()


def test_a_run_whose_process_is_gone_does_not_run_for_ever(store):
    writer = store.writer("cube")
    silent = a_silent_status(stopping=True)
    writer.status(silent)
    wait_until(lambda: store.reader.runs() != [])
    assert store.reader.run("cube").state == "running"  # its process lives
    assert store.reader.run("cube").condition == "stuck"
    writer.close()
    seen = store.reader.run("cube")
    if isinstance(store, Disk):  # nobody has the lock
        assert (seen.state, seen.stopping, seen.heartbeat) == ("interrupted", False, silent.heartbeat)
        assert_one_line(seen.last_error, "vanished", silent.heartbeat.isoformat(timespec="seconds"), "--resume")
        assert DiskReader(store.reader.root).runs() == [seen]  # this one may keep a list that took long
    else:  # it may just not reach Redis
        assert (seen.state, seen.condition, seen.last_error) == ("running", "silent", None)
        assert re.search(r"Redis has heard nothing of it for 6\d s", seen.warnings[-1])


def test_records_that_are_none_are_passed_over(store):
    tell(store, records=[a_record(1), a_record(2)])
    store.damage_records("cube")
    assert [each["iteration"] for each in store.reader.metrics("cube")] == [1, 2]
    assert store.reader.columns("cube", None).iteration.tolist() == [1, 2]


def test_a_damaged_grid(store):
    tell(store, grid=a_grid())
    store.damage("cube", "goals")
    with pytest.raises(DamagedStoreError) as error:
        store.reader.goals("cube")
    assert_one_line(error.value, "goals", "delete", "anew")


def test_a_store_that_is_away(store):
    tell(store)
    store.lose()
    reader = store.reader
    calls = [reader.runs, reader.ready]
    calls += [lambda ask=ask: ask("cube") for ask in (reader.run, reader.metrics, reader.goals, reader.request_stop)]
    for call in calls:
        with pytest.raises(StoreUnavailableError) as error:
            call()
        assert_one_line(error.value, "runs" if isinstance(store, Disk) else "Redis at redis://127.0.0.1:")


def test_many_readers_at_once(store):
    """While the run goes on, nobody sees a record twice, a gap, or half of one."""
    writer, wrong, ends, done = store.writer("cube"), [], [], threading.Event()
    writer.status(a_status())
    writer.metrics(a_record(1))
    wait_until(lambda: store.reader.runs() != [])

    def read():
        last = 0
        while last < 60 and not done.is_set():
            records = store.reader.metrics("cube", after_iteration=last)
            found = [each["iteration"] for each in records]
            if found != list(range(last + 1, last + 1 + len(found))) or store.reader.run("cube").iteration > 60:
                wrong.append((last, found))
            last = max([last, *found])
        ends.append(last)

    threads = [threading.Thread(target=read) for _ in range(6)]
    for thread in threads:
        thread.start()
    for number in range(2, 61):
        writer.metrics(a_record(number))
        writer.status(a_status(iteration=number))
    writer.close()
    for thread in threads:
        thread.join(60.0)
    done.set()
    for thread in threads:
        thread.join()
    assert (wrong, ends) == ([], [60] * 6)
    assert len(store.reader.metrics("cube")) == 60
