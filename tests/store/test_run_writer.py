"""Several writers at once."""

import json

import pytest

from service.io.errors import RunTakenError
from service.io.run_directory import RunDirectory
from service.store.disk import DiskWriter
from service.store.keys import run_key
from service.store.redis_reader import RedisReader
from service.store.redis_writer import RedisWriter
from service.store.run_writer import RunWriter
from tests.store.stores import a_grid, a_record, a_status, wait_until


def test_a_writer_to_disk_and_redis(redis, tmp_path):
    writer = RunWriter(RunDirectory(tmp_path / "run"), "cube", redis.address)
    reader = RedisReader(redis.address)
    writer.status(a_status(iteration=1))
    writer.metrics(a_record(1))
    writer.goals(a_grid(1))
    wait_until(lambda: reader.runs() != [])
    assert not writer.stop_requested()
    reader.request_stop("cube")
    wait_until(writer.stop_requested)
    redis.kill()
    ((_, warning),) = wait_until(writer.troubles)
    assert "Redis" in warning
    writer.status(a_status(iteration=2, state="failed"))
    writer.close()
    assert json.loads((tmp_path / "run" / "status.json").read_text())["iteration"] == 2
    assert json.loads((tmp_path / "run" / "goals.json").read_text())["iteration"] == 1


def test_a_stop_file_stops_a_run_that_tells_redis_too(redis, tmp_path):
    writer = RunWriter(RunDirectory(tmp_path), "cube", redis.address)
    (tmp_path / "stop").touch()
    assert writer.stop_requested()
    writer.close()


def test_a_run_that_another_driver_has_leaves_the_directory_alone(redis, tmp_path):
    other = RedisWriter(redis.address, "cube")
    directory = tmp_path / "run"
    directory.mkdir()
    (directory / "stop").touch()
    with pytest.raises(RunTakenError):
        RunWriter(RunDirectory(directory), "cube", redis.address)
    assert [path.name for path in directory.iterdir()] == ["stop"]
    other.close()


def test_all_are_closed_though_one_fails(redis, tmp_path, monkeypatch):
    writer = RunWriter(RunDirectory(tmp_path), "cube", redis.address)
    writer.goals(a_grid(1))
    writer.goals(a_grid(2))
    close = RedisWriter.close

    def fail(self):
        close(self)
        raise RuntimeError("cannot close")

    monkeypatch.setattr(RedisWriter, "close", fail)
    with pytest.raises(RuntimeError, match="cannot close"):
        writer.close()
    assert json.loads((tmp_path / "goals.json").read_text())["iteration"] == 2
    monkeypatch.undo()
    other, close_on_disk = RunWriter(RunDirectory(tmp_path), "cube", redis.address), DiskWriter.close
    monkeypatch.setattr(DiskWriter, "close", lambda self: [close_on_disk(self), 1 / 0])
    with pytest.raises(ZeroDivisionError):
        other.close()
    assert redis.address.client(1.0).exists(run_key("cube", "lease")) == 0
