"""Redis on a bad day: killed, stopped, restarted, full of something else. The run goes on and loses nothing."""

import os
import signal
import threading
import time

import pytest

from service.base.errors import DamagedStoreError, RunTakenError, StoreUnavailableError
from service.store import address, redis_writer
from service.store.address import RUNS, run_key
from service.store.redis_reader import RedisReader
from tests.runs.runs import assert_one_line
from tests.store.stores import a_grid, a_record, a_status, a_writer, wait_until


@pytest.fixture
def writer(redis):
    writer = a_writer(redis.address, "cube")
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


def test_killed_and_back_at_the_same_place(redis, writer, reader, monkeypatch):
    monkeypatch.setattr(redis_writer, "BATCH", 7)  # some wait when the newest are sent again
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


def test_a_resumed_run_begins_while_redis_is_away(redis, reader, caplog):
    redis.kill()
    with pytest.raises(StoreUnavailableError):
        a_writer(redis.address)
    writer = a_writer(redis.address, resumed=True)
    train(writer, range(1, 11))
    assert len(wait_until(writer.troubles)) == 1
    assert_one_line(caplog.messages[0], "Redis at", "the run goes on")
    redis.revive()
    wait_until(lambda: reader.runs() and iterations(reader)[-1:] == [10])
    assert redis.address.client(1.0).get(run_key("cube", "epoch")) == b"a:1"
    writer.close()


def test_a_resumed_run_whose_id_another_one_has_falls_silent_at_the_first_contact(redis, reader):
    other = a_writer(redis.address, run="b")
    train(other, range(1, 3))
    wait_until(lambda: reader.runs() and iterations(reader) == [1, 2])
    os.kill(redis.pid, signal.SIGSTOP)
    try:
        writer = a_writer(redis.address, resumed=True)
    finally:
        os.kill(redis.pid, signal.SIGCONT)
    wait_until(lambda: any("another process reports there" in each.text for each in writer.troubles()))
    writer.close()
    assert redis.address.client(1.0).get(run_key("cube", "epoch")) == b"b:1"
    other.close()


def test_an_older_process_does_not_take_the_place_of_a_newer_one(redis):
    newer = a_writer(redis.address, epoch=2)
    with pytest.raises(RunTakenError):
        a_writer(redis.address, epoch=1, resumed=True)
    assert redis.address.client(1.0).get(run_key("cube", "epoch")) == b"a:2"
    newer.close()


def test_a_machine_whose_clock_is_ahead_takes_no_other_run_from_the_list(redis, monkeypatch):
    client, now_s = redis.address.client(1.0), time.time()
    client.zadd(RUNS, {"ended": now_s})
    monkeypatch.setattr(time, "time", lambda: now_s + 2 * address.KEPT_S)
    ahead = a_writer(redis.address)
    train(ahead, [1])
    wait_until(lambda: client.zscore(RUNS, "cube"))
    ahead.close()
    assert set(client.zrange(RUNS, 0, -1)) == {b"ended", b"cube"}
    assert client.zscore(RUNS, "cube") == pytest.approx(now_s, abs=600.0)


def test_what_a_run_has_told_goes_some_time_after_its_last_report(redis, writer, reader):
    train(writer, range(1, 3))
    wait_until(lambda: reader.runs() and iterations(reader) == [1, 2])
    writer.close()
    client = redis.address.client(1.0)
    reader.request_stop("cube")
    for key in client.keys("tandem:run:cube:*"):
        assert 0 < client.ttl(key) <= address.KEPT_S, key
    client.zadd(RUNS, {"cube": time.time() - address.KEPT_S - 1.0})
    other = a_writer(redis.address, "other", run="b")
    train(other, [1])
    wait_until(lambda: client.zrange(RUNS, 0, -1) == [b"other"])
    other.close()


def test_stopped_for_a_while(redis, reader, monkeypatch):
    """It does not answer, and its connections stay open: worse than being dead."""
    monkeypatch.setattr(redis_writer, "TIMEOUT_S", 0.3)
    writer = a_writer(redis.address, "cube")
    train(writer, range(1, 6))
    wait_until(lambda: reader.runs() != [])
    os.kill(redis.pid, signal.SIGSTOP)
    try:
        assert returns(lambda: train(writer, range(6, 40)))
        with pytest.raises(StoreUnavailableError, match="no answer in time"):
            reader.ready()
        assert "no answer in time" in wait_until(writer.troubles)[0].text
    finally:
        os.kill(redis.pid, signal.SIGCONT)
    wait_until(lambda: iterations(reader)[-1:] == [39])
    assert iterations(reader) == list(range(1, 40))
    writer.close()


def test_what_redis_forgot_that_it_had_is_sent_again(redis, writer, reader):
    """A machine that loses power takes the last second with it, and all that was answered in it."""
    train(writer, range(1, 11))
    wait_until(lambda: reader.runs() and iterations(reader)[-1:] == [10])
    redis.address.client(1.0).zremrangebyscore(run_key("cube", "metrics"), 6, "+inf")
    redis.address.client(1.0).delete(run_key("cube", "status"), run_key("cube", "goals"))
    redis.kill()
    wait_until(writer.troubles)
    redis.revive()
    wait_until(lambda: reader.runs() != [])
    assert iterations(reader) == list(range(1, 11))
    assert reader.goals("cube") == a_grid(10)


def test_a_restart_between_two_messages_is_noticed(redis, reader, monkeypatch):
    """No call has failed: the client has made a new connection without a word."""
    writer = a_writer(redis.address, "cube")
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


def test_no_more_records_wait_than_redis_keeps(redis, writer, reader, monkeypatch):
    monkeypatch.setattr(address, "MAX_RECORDS", 10)
    writer.status(a_status())
    wait_until(lambda: reader.runs() != [])
    redis.kill()
    wait_until(writer.troubles)
    for number in range(1, 16):
        writer.metrics(a_record(number))
    wait_until(lambda: "; 10 records wait for it" in writer.troubles()[0].text)
    redis.revive()
    wait_until(lambda: iterations(reader) == list(range(6, 16)))


def test_no_more_records_wait_of_a_run_that_was_resumed_while_redis_is_away(redis, reader, monkeypatch):
    monkeypatch.setattr(address, "MAX_RECORDS", 10)
    redis.kill()
    writer = a_writer(redis.address, resumed=True)
    for number in range(1, 16):
        writer.metrics(a_record(number))
    wait_until(lambda: any("; 10 records wait for it" in trouble.text for trouble in writer.troubles()))
    redis.revive()
    writer.status(a_status())
    wait_until(lambda: iterations(reader) == list(range(6, 16)) if reader.runs() else [])
    writer.close()


def test_new_columns_need_new_records_alone(redis, writer, reader, monkeypatch):
    asked, lines_of = [], RedisReader._lines
    monkeypatch.setattr(RedisReader, "_lines", lambda *each: asked.append(lines_of(*each)) or asked[-1])
    writer.status(a_status())
    for number in range(1, 6):
        writer.metrics(a_record(number))
    wait_until(lambda: reader.runs() and iterations(reader) == list(range(1, 6)))
    asked.clear()
    for _ in range(2):
        assert reader.columns("cube", []).iteration.tolist() == [1, 2, 3, 4, 5]
    writer.metrics(a_record(6))
    wait_until(lambda: reader.columns("cube", []).iteration.tolist() == [1, 2, 3, 4, 5, 6])
    assert [len(lines) for lines in asked[:2]] == [5, 1]
    assert {len(lines) for lines in asked[2:]} <= {1, 2}
    writer.metrics(a_record(3, new=1))  # the run went back
    wait_until(lambda: reader.columns("cube", []).iteration.tolist() == [1, 2, 3])


def test_closing_sends_what_waits_and_history_in_redis_is_bounded(redis, reader, monkeypatch):
    monkeypatch.setattr(address, "MAX_RECORDS", 20)
    monkeypatch.setattr(redis_writer, "BATCH", 7)
    writer = a_writer(redis.address)
    for number in range(1, 31):
        writer.metrics(a_record(number))
    writer.status(a_status(state="finished"))
    writer.close()
    assert iterations(reader) == list(range(11, 31))
    assert reader.run("cube").state == "finished"


def test_closing_waits_for_a_bounded_time(redis, caplog, monkeypatch):
    monkeypatch.setattr(redis_writer, "TIMEOUT_S", 3600.0)
    writer = a_writer(redis.address, "cube")
    os.kill(redis.pid, signal.SIGSTOP)
    try:
        writer.metrics(a_record(1))
        assert returns(lambda: writer.close(timeout_s=0.3))
    finally:
        os.kill(redis.pid, signal.SIGCONT)
    assert_one_line(caplog.messages[-1], "did not get the end of run cube", "its files have it")


def test_no_thread_and_no_heartbeat_is_left(redis, writer):
    client = redis.address.client(1.0)
    assert wait_until(lambda: 0 < client.pttl(run_key("cube", "heartbeat")) <= 10_000)
    writer.close()
    assert not writer._thread.is_alive()
    assert client.exists(run_key("cube", "heartbeat")) == 0


# --- who reports -----------------------------------------------------------------------------------------------------


def test_the_next_process_of_a_run_reports_and_the_one_before_falls_silent(redis, reader):
    """As after a freeze: its directory has a newer epoch. What it still says comes to nothing."""
    first = a_writer(redis.address, epoch=1)
    first.status(a_status(iteration=1))
    wait_until(lambda: reader.runs() != [])
    with first._client.connection_pool._lock:  # nothing of it gets through, as of a process that is frozen
        second = a_writer(redis.address, epoch=2)
        second.status(a_status(iteration=2))
        wait_until(lambda: reader.run("cube").iteration == 2)
        second.close()
    first.status(a_status(iteration=1))
    first.metrics(a_record(1))
    wait_until(lambda: not first._thread.is_alive())
    ((condition, warning),) = first.troubles()
    assert condition == "redis"
    assert_one_line(warning, f"Redis at {redis.address} gets nothing more", "another process reports there as run cube")
    first.close()
    assert (reader.run("cube").iteration, iterations(reader)) == (2, [])
    assert redis.address.client(1.0).get(run_key("cube", "epoch")) == b"a:2"


@pytest.mark.parametrize(("found", "goes_on"), [(b"a:2", True), (b"a:4", False), (b"b:1", False), (b"7", False)])
def test_only_a_higher_epoch_or_another_run_is_newer(redis, reader, found, goes_on):
    """A Redis that begins again from an older copy has an older number."""
    client, key = redis.address.client(1.0), run_key("cube", "epoch")
    writer = a_writer(redis.address, epoch=3)
    client.set(key, found)
    writer.status(a_status(iteration=7))
    if goes_on:
        wait_until(lambda: [run.iteration for run in reader.runs()] == [7])
        assert (client.get(key), writer.troubles()) == (b"a:3", [])
    else:
        wait_until(lambda: not writer._thread.is_alive())
        assert client.get(key) == found
    writer.close()


# --- what is wrong ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("content", [b"", b'{"run_id": "cube", "heartbeat": "now"}'])
def test_a_damaged_status_hides_only_its_own_run(redis, reader, caplog, content):
    for run_id in ("cube", "sound"):
        writer = a_writer(redis.address, run_id)
        writer.status(a_status(run_id))
        writer.close()
    redis.address.client(1.0).set(run_key("cube", "status"), content)
    assert [run.run_id for run in reader.runs()] == ["sound"]
    with pytest.raises(DamagedStoreError) as error:
        reader.run("cube")
    assert_one_line(error.value, run_key("cube", "status"), "delete that key")
    assert_one_line(caplog.messages[-1], run_key("cube", "status"))


def test_a_key_of_another_type_is_damage_or_what_redis_says(redis, reader, writer, caplog):
    writer.status(a_status())
    wait_until(lambda: reader.runs() != [])
    client = redis.address.client(1.0)
    client.zadd(RUNS, {"ghost": 1.0, b"\xff": 2.0})
    client.rpush(run_key("other", "status"), 1)
    client.zadd(RUNS, {"other": 3.0})
    assert [run.run_id for run in reader.runs()] == ["cube"]
    assert caplog.messages == []  # they have no status: whoever removed a run left its name
    client.rpush(run_key("cube", "metrics"), 1)
    with pytest.raises(StoreUnavailableError, match="WRONGTYPE"):
        reader.metrics("cube")
    writer.metrics(a_record(1))
    ((_, warning),) = wait_until(writer.troubles)
    assert_one_line(warning, "WRONGTYPE", "1 records wait")
    client.delete(run_key("cube", "metrics"))
    wait_until(lambda: iterations(reader) == [1])
