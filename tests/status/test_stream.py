"""Event streams over real connections, while a run writes its files."""

import json
import time
from contextlib import contextmanager

import httpx
import pytest

from service.io.files import write_atomic
from service.status import stream
from tests.status.conftest import serve
from tests.status.runs import BEARER, append, record, write_status


@pytest.fixture
def root(tmp_path, monkeypatch):
    """A directory of runs with one that goes on, three iterations so far."""
    monkeypatch.setattr(stream, "POLL_S", 0.02)
    write_status(tmp_path / "runs", "cube")
    append(tmp_path / "runs", "cube", record(1), record(2), record(3))
    return tmp_path / "runs"


@pytest.fixture
def service(root):
    with serve(root.parent) as server, httpx.Client(base_url=server.url, headers=BEARER, trust_env=False) as client:
        yield server, client


@contextmanager
def listening(client, query="", headers=None):
    """Events of the run: (kind, data, id) one after the other."""
    url = f"/v1/runs/cube/metrics/stream{query}"
    with client.stream("GET", url, headers=headers, timeout=10) as answer:
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
    """The next events, which have to be of these kinds."""
    taken = [next(stream) for _ in kinds]
    assert [kind for kind, _, _ in taken] == list(kinds)
    return taken


def test_what_is_new_comes_by_itself(root, service):
    with listening(service[1]) as heard:
        newest, first_status = take(heard, "metrics", "status")
        assert newest == ("metrics", record(3), "3")
        assert (first_status[1]["run_id"], first_status[2]) == ("cube", None)
        append(root, "cube", record(4), record(5))
        assert take(heard, "metrics", "metrics") == [("metrics", record(4), "4"), ("metrics", record(5), "5")]
        write_status(root, "cube", iteration=5)
        assert take(heard, "status")[0][1]["iteration"] == 5


def test_it_ends_with_the_run(root, service):
    with listening(service[1]) as heard:
        take(heard, "metrics", "status")
        append(root, "cube", record(4))
        write_status(root, "cube", state="finished", iteration=4)
        *_, last = heard
    assert (last[0], last[1]["state"]) == ("end", "finished")


def test_only_the_metrics_that_were_named(service):
    with listening(service[1], "?names=bob/success_rate&after_iteration=2") as heard:
        assert take(heard, "metrics")[0][1] == {"iteration": 3, "env_steps": 3000, "bob/success_rate": 0.375}


def test_from_the_beginning(service):
    with listening(service[1], "?after_iteration=0") as heard:
        assert [identity for _, _, identity in take(heard, "metrics", "metrics", "metrics")] == ["1", "2", "3"]


def test_a_browser_that_comes_back_goes_on_where_it_was(root, service):
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


def test_a_browser_that_comes_back_after_that(root, service):
    with listening(service[1], headers={"Last-Event-ID": "9"}) as heard:
        assert take(heard, "reset")[0][1] == {"after_iteration": 3}
        append(root, "cube", record(4))
        assert next(event for event in heard if event[0] == "metrics") == ("metrics", record(4), "4")


def test_the_store_is_away_for_a_while(root, service):
    with listening(service[1]) as heard:
        take(heard, "metrics", "status")
        root.rename(root.parent / "elsewhere")
        assert str(root) in take(heard, "unavailable")[0][1]["detail"]
        append(root.parent / "elsewhere", "cube", record(4))
        (root.parent / "elsewhere").rename(root)
        assert take(heard, "metrics") == [("metrics", record(4), "4")]


def test_a_stream_says_that_it_lives(service, monkeypatch):
    monkeypatch.setattr(stream, "KEEP_ALIVE_S", 0.05)
    with service[1].stream("GET", "/v1/runs/cube/metrics/stream", timeout=10) as answer:
        assert ": nothing new" in (line for line in answer.iter_lines())


def test_there_are_not_too_many(root, service, monkeypatch):
    monkeypatch.setattr(stream, "MAX_STREAMS", 1)
    server, client = service
    with listening(client) as heard:
        take(heard, "metrics")
        refused = client.get("/v1/runs/cube/metrics/stream")
        assert (refused.status_code, refused.json()["type"]) == (503, "urn:tandem:too-many-streams")
        assert "tandem_http_streams 1.0" in client.get("/metrics").text
    deadline_s = time.monotonic() + 10
    while server.app.streams.num_open and time.monotonic() < deadline_s:  # hears of the end when it next writes
        append(root, "cube", record(4))
        time.sleep(0.02)
    assert server.app.streams.num_open == 0


def test_the_service_stops_although_somebody_listens(root):
    server = serve(root.parent)
    server.start()
    with httpx.Client(base_url=server.url, trust_env=False) as client, listening(client) as heard:
        take(heard, "metrics", "status")
        begun_s = time.monotonic()
        server.stop()
        assert list(heard) == []
    assert time.monotonic() - begun_s < 1.9  # and not because uvicorn's patience ended, which is at 2 s


def test_no_stream_is_for_ever(root, service):
    service[0].app.streams._max_age_s = 0.0
    with listening(service[1]) as heard:
        assert [kind for kind, _, _ in heard] == ["metrics", "status"]
