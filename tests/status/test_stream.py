"""Event streams over real connections."""

import json
import socket
import time
from contextlib import contextmanager

import httpx
import pytest
from fastapi import routing

from service.base.files import write_atomic
from service.registry.registry import Registry
from service.status import stream
from service.status.server import StatusServer
from service.status.stream import RunFollower
from service.store.disk_reader import DiskReader
from service.store.redis_reader import RedisReader
from tests.status.conftest import serve
from tests.status.runs import BEARER, CLIENT, append, record, status, write_status
from tests.store.redis_server import RedisServer
from tests.store.stores import a_writer


@pytest.fixture
def root(tmp_path, monkeypatch):
    """A directory with one active run of three iterations."""
    monkeypatch.setattr(stream, "POLL_S", 0.02)
    write_status(tmp_path / "runs", "cube")
    append(tmp_path / "runs", "cube", record(1), record(2), record(3))
    return tmp_path / "runs"


@pytest.fixture
def service(root):
    with serve(root.parent) as server, httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        yield server, client


@contextmanager
def listening(client, query="", headers=None):
    """Open a stream; yield an iterator over its events (kind, data, id)."""
    url = f"/v1/runs/cube/metrics/stream{query}"
    with client.stream("GET", url, headers=headers, timeout=300) as answer:
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/event-stream")
        yield events(answer)


def events(answer):
    event = {}
    for line in answer.iter_lines():
        name, _, value = line.partition(": ")
        if line:
            event[name] = value
        elif "event" in event:
            yield event["event"], json.loads(event["data"]), event.get("id")
            event = {}
        else:
            event = {}


def take(stream, *kinds):
    """The next events; asserts their kinds."""
    taken = [next(stream) for _ in kinds]
    assert [kind for kind, _, _ in taken] == list(kinds)
    return taken


def test_new_records_and_changes_are_sent(root, service):
    with listening(service[1]) as heard:
        newest, first_status = take(heard, "metrics", "status")
        assert newest == ("metrics", record(3), "3")
        assert (first_status[1]["run_id"], first_status[2]) == ("cube", None)
        append(root, "cube", record(4), record(5))
        assert take(heard, "metrics", "metrics") == [("metrics", record(4), "4"), ("metrics", record(5), "5")]
        write_status(root, "cube", iteration=5)
        assert take(heard, "status")[0][1]["iteration"] == 5


def test_a_stream_begins_with_the_newest_record_also_without_a_status(root, service):
    (root / "cube" / "config.yaml").touch()
    (root / "cube" / "status.json").unlink()
    with listening(service[1]) as heard:
        assert take(heard, "metrics", "status")[0] == ("metrics", record(3), "3")


def test_the_stream_ends_with_the_run(root, service):
    with listening(service[1]) as heard:
        take(heard, "metrics", "status")
        append(root, "cube", record(4))
        write_status(root, "cube", state="finished", iteration=4)
        *_, last = heard
    assert (last[0], last[1]["state"]) == ("end", "finished")


def test_only_the_metrics_that_were_named(service):
    with listening(service[1], "?names=bob/success_rate&after_iteration=2") as heard:
        assert take(heard, "metrics")[0][1] == {"iteration": 3, "env_steps": 3000, "bob/success_rate": 0.375}


def test_a_browser_that_reconnects_gets_what_it_missed(root, service):
    append(root, "cube", record(4))
    with listening(service[1], "?after_iteration=0", {"Last-Event-ID": "2"}) as heard:
        assert [identity for _, _, identity in take(heard, "metrics", "metrics", "status")] == ["3", "4", None]


def test_a_resumed_run_makes_its_last_iterations_anew(root, service):
    with listening(service[1]) as heard:
        take(heard, "metrics", "status")
        kept = (root / "cube" / "metrics.jsonl").read_bytes().splitlines(keepends=True)[0]
        write_atomic(root / "cube" / "metrics.jsonl", kept)
        assert take(heard, "reset") == [("reset", {"after_iteration": 1}, None)]
        anew = record(2, **{"bob/success_rate": 0.75})
        append(root, "cube", anew)
        assert take(heard, "metrics") == [("metrics", anew, "2")]


def test_a_run_that_is_only_in_redis(tmp_path):
    redis = RedisServer(tmp_path)
    try:
        writer = a_writer(redis.address, "far")
        writer.status(status("far", state="finished", iteration=5))
        for iteration in range(1, 6):
            writer.metrics(record(iteration))
        writer.close()
        with StatusServer(RedisReader(redis.address), Registry(tmp_path / "registry"), port=0) as server:
            url = f"{server.url}/v1/runs/far/metrics/stream?after_iteration=3"
            with httpx.stream("GET", url, **CLIENT) as answer:
                first, second, known, last = events(answer)
            missing = httpx.get(url.replace("far", "nobody"), **CLIENT)
    finally:
        redis.close()
    assert [first, second] == [("metrics", record(4), "4"), ("metrics", record(5), "5")]
    assert (known[0], last[0], last[1]["state"]) == ("status", "end", "finished")
    assert missing.json()["type"] == "urn:tandem:unknown-run"


def test_the_store_is_unavailable_for_a_while(root, service):
    with listening(service[1]) as heard:
        take(heard, "metrics", "status")
        root.rename(root.parent / "elsewhere")
        assert str(root) in take(heard, "unavailable")[0][1]["detail"]
        append(root.parent / "elsewhere", "cube", record(4))
        (root.parent / "elsewhere").rename(root)
        assert take(heard, "metrics") == [("metrics", record(4), "4")]


def test_an_unavailable_store_is_reported_once(root):
    reader, elsewhere = DiskReader(root), root.parent / "elsewhere"
    follower = RunFollower(reader, reader.run("cube"), None, None)
    assert [event.event for event in follower.poll()] == ["metrics", "status"]
    for iteration in (4, 5):
        root.rename(elsewhere)
        assert [[event.event for event in follower.poll()] for _ in range(3)] == [["unavailable"], [], []]
        elsewhere.rename(root)
        append(root, "cube", record(iteration))
        assert [(event.event, event.id) for event in follower.poll()] == [("metrics", str(iteration))]
    assert not follower.ended


def test_a_long_run_comes_in_parts_and_ends_after_the_last(root, monkeypatch):
    monkeypatch.setattr(stream, "MAX_RECORDS", 3)
    append(root, "cube", record(4), record(5))
    write_status(root, "cube", state="finished", iteration=5)
    reader = DiskReader(root)
    follower = RunFollower(reader, reader.run("cube"), None, 0)
    heard = []
    while not follower.ended:
        heard.append([event.id or event.event for event in follower.poll()])
    assert heard == [["1", "2", "3", "status"], ["4", "5"], ["end"]]


def test_the_stream_ends_when_the_run_was_deleted(root, service):
    with listening(service[1]) as heard:
        take(heard, "metrics", "status")
        (root / "cube").rename(root.parent / "cube")
        assert [kind for kind, _, _ in heard] == ["unavailable"]


def test_an_idle_stream_is_kept_alive(service, monkeypatch):
    assert routing._PING_INTERVAL <= 15  # as the document says
    monkeypatch.setattr(routing, "_PING_INTERVAL", 0.05)
    with service[1].stream("GET", "/v1/runs/cube/metrics/stream", timeout=300) as answer:
        assert next(line for line in answer.iter_lines() if line.startswith(":"))


def test_the_number_of_streams_is_limited(root, service, monkeypatch):
    monkeypatch.setattr(stream, "MAX_STREAMS", 1)
    server, client = service
    with listening(client) as heard:
        take(heard, "metrics")
        refused = client.get("/v1/runs/cube/metrics/stream")
        assert (refused.status_code, refused.json()["type"]) == (503, "urn:tandem:too-many-streams")
        assert "tandem_http_streams 1.0" in client.get("/metrics").text
    deadline_s = time.monotonic() + 300
    while server.app.state.streams.num_open and time.monotonic() < deadline_s:
        time.sleep(0.02)
    assert server.app.state.streams.num_open == 0


def test_fifty_browsers_that_never_close_their_connection(root, service, caplog):
    server, client = service
    request = b"GET /v1/runs/cube/metrics/stream HTTP/1.1\r\nHost: localhost\r\n\r\n"
    browsers = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(50)]
    for browser in browsers:
        browser.sendall(request)  # and never reads the answer
    deadline_s = time.monotonic() + 300
    while server.app.state.streams.num_open < 50 and time.monotonic() < deadline_s:
        time.sleep(0.02)
    assert server.app.state.streams.num_open == 50
    append(root, "cube", *(record(i) for i in range(4, 20)))
    answer = client.get("/v1/series", params={"runs": "cube", "names": "bob/success_rate"}).json()
    assert len(answer["runs"][0]["x"]) == 19
    with listening(client, "?after_iteration=18") as heard:
        take(heard, "metrics")
    for browser in browsers:
        browser.close()
    while server.app.state.streams.num_open and time.monotonic() < deadline_s:
        time.sleep(0.02)
    assert server.app.state.streams.num_open == 0
    assert caplog.records == []  # that they went is no error of the service


def test_the_service_stops_with_open_streams(root, monkeypatch):
    """And not because uvicorn's patience ended, or this test's."""
    monkeypatch.setattr("service.status.server._GRACE_S", 3600)
    monkeypatch.setattr("service.status.server.STOP_TIMEOUT_S", 300.0)
    server = serve(root.parent)
    server.start()
    with httpx.Client(base_url=server.url, **CLIENT) as client, listening(client) as heard:
        take(heard, "metrics", "status")
        server.stop()
        assert not server._thread.is_alive()
        assert list(heard) == []


def test_a_stream_has_a_greatest_age(service, monkeypatch):
    monkeypatch.setattr(stream, "MAX_AGE_S", 0.0)
    with listening(service[1]) as heard:
        assert [kind for kind, _, _ in heard] == ["metrics", "status"]
