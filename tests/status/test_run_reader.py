"""Runs in directories and in a real Redis, also while Redis is unavailable."""

from datetime import UTC, datetime, timedelta

import pytest

from service.base.errors import DamagedStoreError, StoreUnavailableError, UnknownRunError
from service.status.run_reader import RETRY_AFTER_S, CombinedReader, open_reader
from service.store.address import run_key
from service.store.disk_reader import DiskReader
from service.store.redis_reader import RedisReader
from tests.status.runs import append, grid, record, status, write_runs, write_status
from tests.store.redis_server import RedisServer
from tests.store.stores import a_writer, wait_until


@pytest.fixture(scope="module")
def redis(tmp_path_factory):
    """A Redis with the runs "cube", which also has a directory, and "far", which has none."""
    killable = RedisServer(tmp_path_factory.mktemp("redis"))
    for run_id in ("cube", "far"):
        writer = a_writer(killable.address, run_id)
        writer.status(status(run_id, iteration=7, state="interrupted" if run_id == "far" else "running"))
        writer.metrics(record(1))
        writer.goals(grid().model_copy(update={"iteration": 7}))
        writer.close()
    yield killable
    killable.close()


@pytest.fixture
def root(tmp_path):
    write_runs(tmp_path / "runs")
    return tmp_path / "runs"


@pytest.fixture
def time_s():
    return [0.0]


@pytest.fixture
def reader(redis, root, time_s):
    return CombinedReader(DiskReader(root), RedisReader(redis.address), clock=lambda: time_s[0])


def test_runs_of_both(reader):
    runs = {run.run_id: run for run in reader.runs()}
    assert list(runs)[-1] == "old"
    assert {run_id: run.iteration for run_id, run in runs.items()} == {"cube": 7, "far": 7, "old": 3}
    assert {run_id: reader.run(run_id) for run_id in runs} == runs


def test_a_directory_that_was_written_later(reader, root):
    write_status(root, "cube", iteration=9, heartbeat=datetime.now(UTC) + timedelta(minutes=1))
    assert reader.run("cube").iteration == 9


def test_another_run_with_the_same_id_in_redis_is_not_shown_or_stopped(reader, redis, root):
    client, key = redis.address.client(1.0), run_key("cube", "status")
    sound = client.get(key)
    client.set(key, status("cube", iteration=7, identity="theirs").model_dump_json())
    write_status(root, "cube", identity="ours", iteration=3, heartbeat=datetime.now(UTC) - timedelta(seconds=5))
    for shown in (reader.run("cube"), next(run for run in reader.runs() if run.run_id == "cube")):
        assert (shown.identity, shown.iteration) == ("ours", 3)
        assert "two runs have the id cube" in shown.warnings[0]
        assert "the second is not shown" in shown.warnings[0]
    reader.request_stop("cube")
    assert (root / "cube" / "stop").exists()
    assert not RedisReader(redis.address).run("cube").stopping
    write_status(root, "cube", identity="ours", iteration=3, state="finished")
    shown = reader.run("cube")
    assert (shown.identity, shown.iteration, len(shown.warnings)) == ("theirs", 7, 1)
    assert "curves and files shown here are those of the first" in shown.warnings[0]
    reader.request_stop("cube")
    assert RedisReader(redis.address).run("cube").stopping
    client.delete(run_key("cube", "stop"))
    client.set(key, status("cube", iteration=7, identity="theirs", state="finished").model_dump_json())
    assert (reader.run("cube").identity, reader.run("cube").warnings) == ("ours", ())
    client.set(key, sound)


def test_a_damaged_status_in_redis_does_not_hide_a_sound_directory(reader, redis):
    client, keys = redis.address.client(1.0), [run_key(run_id, "status") for run_id in ("cube", "far")]
    sound = client.mget(keys)
    client.mset(dict.fromkeys(keys, b"torn"))
    assert reader.run("cube").iteration == 3
    assert "cube" in [run.run_id for run in reader.runs()]
    with pytest.raises(DamagedStoreError):
        reader.run("far")  # of another machine
    client.mset(dict(zip(keys, sound, strict=True)))


def test_metrics_and_goals_come_from_the_directory_where_there_is_one(reader, root):
    append(root, "cube", record(4))
    assert [each["iteration"] for each in reader.metrics("cube", after_iteration=1)] == [2, 3, 4]
    assert [each["iteration"] for each in reader.metrics("far")] == [1]
    assert [reader.goals(run_id).iteration for run_id in ("cube", "far")] == [3, 7]
    assert reader.goals("old") is None


def test_a_request_to_stop_goes_to_both(reader, redis, root):
    reader.request_stop("cube")
    assert (root / "cube" / "stop").exists()
    assert RedisReader(redis.address).run("cube").stopping
    reader.request_stop("far")  # has ended


def test_a_run_of_redis_alone_that_has_no_record_yet(root, tmp_path):
    redis = RedisServer(tmp_path)
    try:
        writer = a_writer(redis.address, "begun")
        writer.status(status("begun", iteration=0))
        writer.close()
        reader = CombinedReader(DiskReader(root), RedisReader(redis.address))
        assert reader.newest("begun") is None
        assert reader.goals("begun") is None
        assert reader.metrics("begun") == []
    finally:
        redis.close()


@pytest.mark.parametrize("call", ["run", "metrics", "goals", "request_stop"])
def test_an_unknown_run(reader, call):
    with pytest.raises(UnknownRunError, match=r"no run 'nobody'"):
        getattr(reader, call)("nobody")


def test_redis_is_unavailable_and_comes_back(reader, redis, root, time_s, caplog):
    redis.kill()
    try:
        assert {run.run_id: run.iteration for run in reader.runs()} == {"cube": 3, "old": 3}
        cube, old = reader.run("cube"), reader.run("old")
        assert "reads no Redis" in cube.warnings[0]
        assert old.warnings == ()
        assert reader.metrics("cube")
        assert reader.goals("cube").iteration == 3
        reader.request_stop("cube")
        reader.ready()
        assert (root / "cube" / "stop").exists()
        assert len(caplog.records) == 1  # said once, however often it is asked for
        for call in ("run", "metrics", "goals", "request_stop"):  # it may have a run of this name
            with pytest.raises(StoreUnavailableError, match="Redis is away"):
                getattr(reader, call)("far")
    finally:
        redis.revive()
    assert {run.run_id for run in reader.runs()} == {"cube", "old"}  # it is left alone for a while
    time_s[0] += RETRY_AFTER_S
    wait_until(lambda: {run.run_id for run in reader.runs()} == {"cube", "far", "old"})
    assert reader.run("cube").warnings == ()


def test_runs_of_redis_alone_are_shown_as_they_were_last(redis, tmp_path, time_s):
    (tmp_path / "empty").mkdir()
    reader = CombinedReader(DiskReader(tmp_path / "empty"), RedisReader(redis.address), clock=lambda: time_s[0])
    assert {run.run_id for run in reader.runs()} == {"cube", "far"}
    redis.kill()
    try:
        shown = {run.run_id: run for run in reader.runs()}
        assert shown["cube"].iteration == 7
        assert "reads no Redis" in shown["cube"].warnings[0]  # so that there is an alert
        assert reader.run("cube") == shown["cube"]
        with pytest.raises(StoreUnavailableError):
            reader.request_stop("cube")
    finally:
        redis.revive()


def test_which_reader(root, redis, monkeypatch):
    monkeypatch.delenv("TANDEM_REDIS_URL", raising=False)
    assert isinstance(open_reader(root), DiskReader)
    monkeypatch.setenv("TANDEM_REDIS_URL", redis.address.url)
    assert {run.run_id for run in open_reader(root).runs()} == {"cube", "far", "old"}
