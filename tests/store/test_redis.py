"""Redis on a bad day: killed, stopped, restarted, full of something else. The run goes on and loses nothing."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from service.io.errors import RunTakenError
from service.store import keys, redis_writer
from service.store.address import RedisAddress
from service.store.errors import DamagedStoreError, StoreUnavailableError
from service.store.redis_reader import RedisReader
from service.store.redis_writer import RedisWriter
from tests.runtime.runs import assert_one_line
from tests.store.stores import a_grid, a_record, a_status, wait_until

DRIVE = """
import sys, time
from service.store.address import RedisAddress
from service.store.redis_writer import RedisWriter
writer = RedisWriter(RedisAddress(sys.stdin.readline().strip()), "cube", lease_s=1.0)
print("has it", flush=True)
time.sleep(60)
"""


@pytest.fixture
def writer(redis):
    writer = RedisWriter(redis.address, "cube")
    yield writer
    writer.close()


@pytest.fixture
def reader(redis):
    return RedisReader(redis.address)


def iterations(reader):
    return [each["iteration"] for each in reader.metrics("cube")]


def train(writer, numbers):
    """Tell like a training thread."""
    for number in numbers:
        writer.metrics(a_record(number))
        writer.status(a_status(iteration=number, warnings=tuple(each.text for each in writer.troubles())))
        writer.goals(a_grid(number))
        writer.stop_requested()
        time.sleep(0.005)


def returns(call):
    """Let another thread do it; whether it has returned, long before any time-out of an hour."""
    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(600.0)
    return not thread.is_alive()


# --- away ------------------------------------------------------------------------------------------------------------


def test_killed_and_back_at_the_same_place(redis, writer, reader):
    train(writer, range(1, 31))
    wait_until(lambda: reader.runs() and iterations(reader)[-1:] == [30])
    redis.kill()
    train(writer, range(31, 131))
    ((_, warning),) = wait_until(writer.troubles)
    assert_one_line(warning, f"Redis at {redis.address} has taken nothing for", "refused", "records wait")
    redis.revive()
    wait_until(lambda: iterations(reader)[-1:] == [130])
    assert iterations(reader) == list(range(1, 131))
    assert reader.run("cube").iteration == 130
    assert reader.goals("cube").iteration == 130
    wait_until(lambda: writer.troubles() == [])


@pytest.mark.parametrize("timeout_s", [0.3, 3600.0])
def test_stopped_for_a_while(redis, reader, monkeypatch, timeout_s):
    """It answers nobody, and its connections stay open: worse than being dead."""
    monkeypatch.setattr(redis_writer, "TIMEOUT_S", timeout_s)
    writer = RedisWriter(redis.address, "cube")
    train(writer, range(1, 6))
    wait_until(lambda: reader.runs() != [])
    os.kill(redis.server.pid, signal.SIGSTOP)
    try:
        assert returns(lambda: train(writer, range(6, 40)))
        with pytest.raises(StoreUnavailableError, match="no answer in time"):
            reader.ready()
        if timeout_s < 1.0:
            assert "no answer in time" in wait_until(writer.troubles)[0].text
    finally:
        os.kill(redis.server.pid, signal.SIGCONT)
    wait_until(lambda: iterations(reader)[-1:] == [39])
    assert iterations(reader) == list(range(1, 40))
    writer.close()


def test_what_redis_forgot_that_it_had_is_sent_again(redis, writer, reader):
    """A machine that loses power takes the last second with it, and all that was answered in it."""
    train(writer, range(1, 11))
    wait_until(lambda: reader.runs() and iterations(reader)[-1:] == [10])
    redis.address.client(1.0).zremrangebyscore(keys.run_key("cube", "metrics"), 6, "+inf")
    redis.address.client(1.0).delete(keys.run_key("cube", "status"), keys.run_key("cube", "goals"))
    redis.kill()
    wait_until(writer.troubles)
    redis.revive()
    wait_until(lambda: reader.runs() != [])
    assert iterations(reader) == list(range(1, 11))
    assert reader.goals("cube") == a_grid(10)


def test_a_restart_between_two_messages_is_noticed(redis, reader, monkeypatch):
    """No call has failed: the client has made a new connection without a word."""
    writer = RedisWriter(redis.address, "cube")
    train(writer, range(1, 11))
    wait_until(lambda: reader.runs() and iterations(reader)[-1:] == [10])
    monkeypatch.setattr(redis_writer, "TICK_S", 3600.0)
    time.sleep(0.2)  # from now on it waits for that long
    redis.address.client(1.0).flushall()
    redis.kill()
    redis.revive()
    writer.close()
    assert iterations(reader) == list(range(1, 11))
    assert reader.run("cube").iteration == 10
    assert reader.goals("cube") == a_grid(10)


def test_a_run_that_goes_back_by_itself(writer, reader):
    """As when the machine that had the newest state is lost."""
    train(writer, range(1, 8))
    train(writer, range(4, 6))
    wait_until(lambda: reader.runs() and iterations(reader) == [1, 2, 3, 4, 5])
    assert reader.run("cube").iteration == 5


def test_a_disk_that_lost_everything_gets_what_comes(redis, writer, reader):
    train(writer, range(1, 4))
    wait_until(lambda: reader.runs() != [])
    redis.address.client(1.0).flushall()
    writer.status(a_status(iteration=4))
    wait_until(lambda: reader.runs() != [])
    assert reader.run("cube").iteration == 4


def test_too_many_records_for_memory_are_counted(redis, writer, reader, monkeypatch):
    monkeypatch.setattr(redis_writer, "MAX_WAITING", 10)
    writer.status(a_status())
    wait_until(lambda: reader.runs() != [])
    redis.kill()
    wait_until(writer.troubles)
    for number in range(1, 16):
        writer.metrics(a_record(number))
    assert "5 records did not reach Redis" in writer.troubles()[-1].text
    redis.revive()
    wait_until(lambda: len(iterations(reader)) == 10)
    assert iterations(reader) == list(range(6, 16))


def test_history_in_redis_is_bounded(writer, reader, monkeypatch):
    monkeypatch.setattr(keys, "MAX_RECORDS", 20)
    for number in range(1, 1201):  # more than one message takes
        writer.metrics(a_record(number))
    writer.status(a_status())
    wait_until(lambda: reader.runs() and iterations(reader)[-1:] == [1200])
    assert iterations(reader) == list(range(1181, 1201))


def test_closing_waits_for_a_bounded_time(redis, caplog, monkeypatch):
    monkeypatch.setattr(redis_writer, "TIMEOUT_S", 3600.0)
    writer = RedisWriter(redis.address, "cube")
    os.kill(redis.server.pid, signal.SIGSTOP)
    try:
        writer.metrics(a_record(1))
        assert returns(lambda: writer.close(timeout_s=0.3))
    finally:
        os.kill(redis.server.pid, signal.SIGCONT)
    assert_one_line(caplog.messages[-1], "did not get the end of run cube", "its files have it")


def test_closing_sends_what_waits(redis, reader):
    writer = RedisWriter(redis.address, "cube")
    for number in range(1, 1201):
        writer.metrics(a_record(number))
    writer.status(a_status(state="finished"))
    writer.close()
    assert len(iterations(reader)) == 1200
    assert reader.run("cube").state == "finished"


def test_a_reader_goes_on_when_redis_is_back(redis, writer, reader):
    writer.status(a_status())
    wait_until(lambda: reader.runs() != [])
    redis.kill()
    with pytest.raises(StoreUnavailableError) as error:
        reader.run("cube")
    assert_one_line(error.value, f"Redis at {redis.address}")
    redis.revive()
    wait_until(lambda: reader.runs() != [])  # it may have forgotten the last second, which the writer knows
    assert reader.run("cube").run_id == "cube"


def test_no_thread_and_no_lease_is_left(redis):
    writer = RedisWriter(redis.address, "cube")
    writer.close()
    assert not writer._thread.is_alive()
    assert redis.address.client(1.0).exists(keys.run_key("cube", "lease")) == 0


# --- who runs it -----------------------------------------------------------------------------------------------------


def test_two_drivers_of_one_run_refuse_each_other(redis):
    """At once: a lease that is renewed is not waited for."""
    writer, errors = RedisWriter(redis.address, "cube", lease_s=3600.0), []

    def second():
        with pytest.raises(RunTakenError) as error:
            RedisWriter(redis.address, "cube", lease_s=3600.0)
        errors.append(error.value)

    assert returns(second)
    host = os.uname().nodename
    assert_one_line(errors[0], "run cube is being run by", f"process {os.getpid()} on {host}", "another id")
    RedisWriter(redis.address, "cube-2").close()
    writer.close()


def test_the_next_driver_may_begin_at_once(redis, writer):
    writer.close()
    assert returns(lambda: RedisWriter(redis.address, "cube", lease_s=3600.0).close())


def test_a_driver_that_was_killed_leaves_the_run_to_the_next(redis):
    with subprocess.Popen(
        [sys.executable, "-c", DRIVE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as driver:
        driver.stdin.write(redis.address.url + "\n")
        driver.stdin.flush()
        assert driver.stdout.readline() == "has it\n"
        with pytest.raises(RunTakenError, match=f"process {driver.pid} on"):
            RedisWriter(redis.address, "cube")
        driver.kill()
    RedisWriter(redis.address, "cube", lease_s=10.0).close()


def test_a_lease_outlives_an_outage(redis, reader):
    """It has expired by the time Redis is back, and nobody else has come."""
    writer = RedisWriter(redis.address, "cube", lease_s=1.0)
    redis.kill()
    wait_until(writer.troubles)
    time.sleep(1.1)
    redis.revive()
    writer.status(a_status())
    wait_until(lambda: reader.runs() != [])
    with pytest.raises(RunTakenError):
        RedisWriter(redis.address, "cube", lease_s=5.0)
    writer.close()


def test_a_driver_that_was_taken_over_is_silent(redis, reader, caplog):
    writer = RedisWriter(redis.address, "cube")
    writer.status(a_status(iteration=1))
    wait_until(lambda: reader.runs() != [])
    theirs = b'{"token": "x", "host": "elsewhere", "pid": 7, "since": "today"}'
    redis.address.client(1.0).set(keys.run_key("cube", "lease"), theirs)
    wait_until(lambda: not writer._thread.is_alive())
    with pytest.raises(RunTakenError) as error:
        writer.check()
    assert_one_line(error.value, "run cube was taken over by process 7 on elsewhere", "stops")
    writer.status(a_status(iteration=2))
    writer.close()
    assert reader.run("cube").iteration == 1
    assert redis.address.client(1.0).get(keys.run_key("cube", "lease")) == theirs


def test_a_driver_that_was_frozen_while_another_began_and_ended_writes_nothing(redis, reader):
    """The lease is free again; the number of the claim tells."""
    first = RedisWriter(redis.address, "cube", lease_s=0.5)
    client = redis.address.client(1.0)
    with first._client.connection_pool._lock:  # nothing of it gets through, as of a process that is frozen
        wait_until(lambda: not client.exists(keys.run_key("cube", "lease")))
        second = RedisWriter(redis.address, "cube")
        second.status(a_status(iteration=2))
        wait_until(lambda: reader.runs() != [])
        second.close()
    first.status(a_status(iteration=1))
    wait_until(lambda: not first._thread.is_alive())
    with pytest.raises(RunTakenError, match="another process, which has ended since"):
        first.check()
    first.close()
    assert reader.run("cube").iteration == 2
    assert client.get(keys.run_key("cube", "epoch")) == b"2"


@pytest.mark.parametrize(("number", "goes_on"), [(b"3", True), (b"2", True), (b"4", False), (b"many", False)])
def test_only_a_higher_number_is_a_takeover(redis, reader, number, goes_on):
    """A Redis that begins again from an older copy has an older number."""
    client, key = redis.address.client(1.0), keys.run_key("cube", "epoch")
    client.set(key, 2)
    writer = RedisWriter(redis.address, "cube")
    client.set(key, number)
    if goes_on:
        wait_until(lambda: client.get(key) == b"3")
        client.set(key, number)
        writer.status(a_status(iteration=7))
        wait_until(lambda: [run.iteration for run in reader.runs()] == [7])
        writer.check()
    else:
        wait_until(lambda: not writer._thread.is_alive())
        with pytest.raises(RunTakenError):
            writer.check()
    writer.close()


def test_a_lease_that_never_expires_is_no_endless_wait(redis):
    redis.address.client(1.0).set(keys.run_key("cube", "lease"), b"\xff nobody")
    with pytest.raises(RunTakenError, match="another process"):
        RedisWriter(redis.address, "cube", lease_s=0.2)


# --- what is wrong ---------------------------------------------------------------------------------------------------


def test_a_run_does_not_begin_without_the_redis_it_was_given(redis):
    wrong = RedisAddress(redis.address.url.replace("redis://:", "redis://:not-"))
    with pytest.raises(StoreUnavailableError, match="wrong or missing password"):
        RedisWriter(wrong, "cube")
    with pytest.raises(StoreUnavailableError, match="wrong or missing password"):
        RedisReader(wrong).runs()
    redis.kill()
    with pytest.raises(StoreUnavailableError) as error:
        RedisWriter(redis.address, "cube")
    assert_one_line(error.value, f"Redis at {redis.address}", "refused")


@pytest.mark.parametrize("content", [b"", b"{}", b"\xff", b"[1]", b'{"run_id": "cube", "heartbeat": "now"}'])
def test_a_damaged_status_hides_only_its_own_run(redis, reader, caplog, content):
    for run_id in ("cube", "sound"):
        writer = RedisWriter(redis.address, run_id)
        writer.status(a_status(run_id))
        writer.close()
    redis.address.client(1.0).set(keys.run_key("cube", "status"), content)
    assert [run.run_id for run in reader.runs()] == ["sound"]
    with pytest.raises(DamagedStoreError) as error:
        reader.run("cube")
    assert_one_line(error.value, keys.run_key("cube", "status"), "delete that key")
    assert_one_line(caplog.messages[-1], keys.run_key("cube", "status"))


def test_keys_of_another_type(redis, reader, writer):
    writer.status(a_status())
    wait_until(lambda: reader.runs() != [])
    client = redis.address.client(1.0)
    client.delete(keys.run_key("cube", "metrics"))
    client.rpush(keys.run_key("cube", "metrics"), 1)
    with pytest.raises(DamagedStoreError) as error:
        reader.metrics("cube")
    assert_one_line(error.value, f"Redis at {redis.address}", "another type", "delete tandem:*")
    writer.metrics(a_record(1))
    ((_, warning),) = wait_until(writer.troubles)
    assert_one_line(warning, "WRONGTYPE", "1 records wait")
    client.delete(keys.run_key("cube", "metrics"))
    wait_until(lambda: iterations(reader) == [1])


def test_an_index_that_names_a_run_without_a_status(redis, reader, caplog):
    redis.address.client(1.0).zadd(keys.RUNS, {"ghost": 1.0, b"\xff": 2.0})
    assert reader.runs() == []
    assert len(caplog.messages) == 2


def test_full_of_data(redis, writer, reader):
    """Redis may refuse to write when its memory is full; that passes."""
    writer.status(a_status())
    wait_until(lambda: reader.runs() != [])
    client = redis.address.client(1.0)
    client.config_set("maxmemory", "1")
    writer.metrics(a_record(1))
    ((_, warning),) = wait_until(writer.troubles)
    assert "maxmemory" in warning
    client.config_set("maxmemory", "0")
    wait_until(lambda: iterations(reader) == [1])
