"""A run's reports to its directory and to Redis at once."""

import json

import pytest

from service.base.errors import RunTakenError
from service.store.address import run_key
from service.store.redis_reader import RedisReader
from service.store.run_directory import RunDirectory
from service.store.run_writer import RunWriter, reporting_to
from tests.runs.runs import assert_one_line
from tests.store.stores import a_grid, a_record, a_status, a_writer, wait_until


def test_a_writer_to_disk_and_redis(redis, tmp_path):
    writer = RunWriter(RunDirectory(tmp_path / "run"), a_writer(redis.address))
    reader = RedisReader(redis.address)
    writer.status(a_status(iteration=1))
    writer.metrics(a_record(1))
    writer.goals(a_grid(1))
    wait_until(lambda: reader.runs() != [])
    assert not writer.stop_requested()
    reader.request_stop("cube")
    wait_until(writer.stop_requested)
    redis.kill()
    ((condition, warning),) = wait_until(writer.troubles)
    assert condition == "redis"
    assert_one_line(warning, "Redis")
    writer.status(a_status(iteration=2, state="failed"))
    writer.goals(a_grid(2))
    writer.close()
    for name in ("status.json", "goals.json"):
        assert json.loads((tmp_path / "run" / name).read_text())["iteration"] == 2


def test_a_stop_file_stops_a_run_that_tells_redis_too(redis, tmp_path):
    writer = RunWriter(RunDirectory(tmp_path), a_writer(redis.address))
    (tmp_path / "stop").touch()
    assert writer.stop_requested()
    writer.close()


def test_a_run_whose_id_another_one_has_in_redis_leaves_the_directory_alone(redis, tmp_path):
    directory = RunDirectory(tmp_path / "run")
    directory.claim(resume=False)
    (directory.path / "stop").touch()
    other = a_writer(redis.address)
    wait_until(lambda: redis.address.client(1.0).exists(run_key("cube", "heartbeat")))
    with pytest.raises(RunTakenError) as error:
        reporting_to(directory, "cube", redis.address)
    assert_one_line(error.value, "another run with the id cube reports to Redis at", "wait 10 s", "--run-dir")
    assert (directory.path / "stop").exists()
    other.close()
    reporting_to(directory, "cube", redis.address).close()
    mine = f"{directory.history.run}:{directory.epoch}".encode()
    assert redis.address.client(1.0).get(run_key("cube", "epoch")) == mine
    directory.close()
