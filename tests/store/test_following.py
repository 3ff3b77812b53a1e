"""Several writers at once, and waiting for what comes."""

import asyncio
import json

import pytest

from service.io.errors import RunTakenError
from service.store.disk import DiskWriter
from service.store.errors import UnknownRunError
from service.store.fanout import FanoutWriter, open_writer
from service.store.following import follow
from service.store.redis_reader import RedisReader
from service.store.redis_writer import RedisWriter
from tests.store.stores import a_grid, a_record, a_status, wait_until


def test_a_writer_to_disk_and_redis(redis, tmp_path):
    writer = open_writer(tmp_path / "run", "cube", redis.address)
    reader = RedisReader(redis.address)
    writer.status(a_status(iteration=1))
    writer.metrics(a_record(1))
    writer.goals(a_grid(1))
    wait_until(lambda: reader.runs() != [])
    assert not writer.stop_requested()
    reader.request_stop("cube")
    wait_until(writer.stop_requested)
    redis.kill()
    (warning,) = wait_until(writer.warnings)
    assert "Redis" in warning
    writer.status(a_status(iteration=2, state="failed"))
    writer.close()
    assert json.loads((tmp_path / "run" / "status.json").read_text())["iteration"] == 2
    assert json.loads((tmp_path / "run" / "goals.json").read_text())["iteration"] == 1


def test_a_stop_file_stops_a_run_that_tells_redis_too(redis, tmp_path):
    writer = open_writer(tmp_path, "cube", redis.address)
    (tmp_path / "stop").touch()
    assert writer.stop_requested()
    writer.close()


def test_a_run_that_another_driver_has_leaves_the_directory_alone(redis, tmp_path):
    other = RedisWriter(redis.address, "cube")
    directory = tmp_path / "run"
    directory.mkdir()
    (directory / "stop").touch()
    with pytest.raises(RunTakenError):
        open_writer(directory, "cube", redis.address)
    assert [path.name for path in directory.iterdir()] == ["stop"]
    other.close()


def test_all_are_closed_though_one_fails(tmp_path):
    class Failing(DiskWriter):
        def close(self):
            raise RuntimeError("cannot close")

    last = DiskWriter(tmp_path)
    writer = FanoutWriter([Failing(tmp_path / "a"), last])
    last.goals(a_grid(1))
    last.goals(a_grid(2))
    with pytest.raises(RuntimeError, match="cannot close"):
        writer.close()
    assert json.loads((tmp_path / "goals.json").read_text())["iteration"] == 2


def test_records_come_until_the_run_has_ended(redis):
    reader = RedisReader(redis.address)

    async def watch():
        writer = RedisWriter(redis.address, "cube")
        writer.status(a_status())
        writer.metrics(a_record(1))
        while not reader.runs():
            await asyncio.sleep(0.01)
        seen = []
        async for records in follow(reader, "cube", poll_s=0.01):
            seen.append([each["iteration"] for each in records])
            if seen[-1] == [1]:
                writer.metrics(a_record(2))
            if seen[-1] == [2]:
                writer.metrics(a_record(3))
                writer.status(a_status(state="finished"))
                await asyncio.to_thread(writer.close)
        return seen

    seen = asyncio.run(asyncio.wait_for(watch(), 10.0))
    assert [number for numbers in seen for number in numbers] == [1, 2, 3]


def test_a_quiet_run_gives_signs_of_life(redis):
    writer = RedisWriter(redis.address, "cube")
    writer.status(a_status())
    reader = RedisReader(redis.address)
    wait_until(lambda: reader.runs() != [])

    async def listen():
        following = follow(reader, "cube", poll_s=0.01, quiet_s=0.05)
        return [await anext(following) for _ in range(3)]

    assert asyncio.run(asyncio.wait_for(listen(), 10.0)) == [[], [], []]
    writer.close()


def test_following_starts_after_what_is_known(redis):
    writer = RedisWriter(redis.address, "cube")
    writer.status(a_status(state="finished"))
    for number in range(1, 6):
        writer.metrics(a_record(number))
    writer.close()
    reader = RedisReader(redis.address)

    async def collect(run_id):
        return [each async for each in follow(reader, run_id, after_iteration=3)]

    assert asyncio.run(collect("cube")) == [[a_record(4), a_record(5)]]
    with pytest.raises(UnknownRunError):
        asyncio.run(collect("nobody"))
