"""What a client can do before its request is whole: take neither memory, nor places, nor the service's time."""

import os
import socket
import threading
import time

import httpx
import pytest

from service.status import connections
from service.store.disk_reader import DiskReader
from tests.status.conftest import serve
from tests.status.runs import BEARER, CLIENT


@pytest.fixture
def server(home):
    with serve(home) as server:
        yield server


def connect(server):
    return socket.create_connection(("127.0.0.1", server.port), timeout=60.0)


def received(connection):
    """All bytes until the service closes."""
    data = b""
    while True:
        try:
            piece = connection.recv(65536)
        except ConnectionResetError:
            return data
        if not piece:
            return data
        data += piece


def is_well(server):
    return httpx.get(f"{server.url}/livez", **CLIENT).status_code == 200


def test_a_head_that_is_too_large_is_refused_before_it_is_whole(server):
    with connect(server) as connection:
        connection.sendall(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n")
        answer = []
        reader = threading.Thread(target=lambda: answer.append(received(connection)))
        reader.start()
        sent = 0
        try:
            while reader.is_alive() and sent < 50_000_000:
                sent += connection.send(b"x: " + b"a" * 5000 + b"\r\n")
        except OSError:  # closed, and that is what is wanted
            pass
        reader.join()
    assert sent < 50_000_000
    assert is_well(server)


def test_a_head_of_many_small_pieces_is_refused_too(server):
    with connect(server) as connection:
        connection.sendall(b"GET /livez HTTP/1.1\r\n" + b"x: y\r\n" * 9_000)
        connection.sendall(b"x: y\r\n" * 9_000)
        assert received(connection).startswith(b"HTTP/1.1 431 ")
    assert is_well(server)


def test_a_request_that_is_never_finished_is_given_up(server, monkeypatch):
    monkeypatch.setattr(connections, "HEAD_TIMEOUT_S", 0.5)
    with connect(server) as silent, connect(server) as slow, connect(server) as second:
        slow.sendall(b"GET /livez HTTP/1.1\r\nx:")
        second.sendall(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n")
        time.sleep(0.1)
        second.sendall(b"GET /li")  # of a request after one that was answered
        for connection in (silent, slow):
            assert received(connection) == b""
        assert received(second).startswith(b"HTTP/1.1 200 ")
    assert is_well(server)


def test_requests_one_after_the_other_and_long_bodies_are_no_long_heads(server):
    with httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        for _ in range(5):
            assert client.post("/v1/runs/none/stop", content=b"a" * 60_000).status_code == 404
        assert client.get("/livez", headers={"x": "a" * 30_000}).status_code == 200


def wait_for_connections(server, num):
    deadline_s = time.monotonic() + 60.0
    while len(server._server.server_state.connections) != num and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert len(server._server.server_state.connections) == num


def test_where_all_places_are_taken_the_longest_idle_connection_gives_way(server, monkeypatch):
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 5)
    oldest, second = connect(server), connect(server)
    wait_for_connections(server, 2)
    others = [connect(server) for _ in range(3)]
    wait_for_connections(server, 5)
    oldest.sendall(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n")  # it is no longer the one that is idle longest
    assert oldest.recv(100).startswith(b"HTTP/1.1 200 ")
    assert is_well(server)
    assert received(second) == b""
    wait_for_connections(server, 4)
    for connection in (oldest, *others):
        connection.close()
    wait_for_connections(server, 0)


def test_no_more_connections_than_may_be_where_all_have_a_request(server, monkeypatch):
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 5)
    waiting, over = threading.Semaphore(0), threading.Event()
    monkeypatch.setattr(DiskReader, "run", lambda *_: waiting.release() or over.wait(60.0))
    asking = []
    for number in range(5):
        asking.append(connect(server))
        token = BEARER["Authorization"]
        asking[-1].sendall(
            f"GET /v1/runs/{number} HTTP/1.1\r\nhost: localhost\r\nauthorization: {token}\r\n\r\n".encode()
        )
        assert waiting.acquire(timeout=60.0)
    with connect(server) as one_too_many:
        assert received(one_too_many).startswith(b"HTTP/1.1 503 ")
    over.set()
    for connection in asking:
        assert connection.recv(100).startswith(b"HTTP/1.1 ")  # it was left alone
        connection.close()
    wait_for_connections(server, 0)
    assert is_well(server)


def test_it_is_alive_while_every_thread_waits_for_a_file(server, monkeypatch):
    waiting, over = threading.Semaphore(0), threading.Event()
    monkeypatch.setattr(DiskReader, "run", lambda *_: waiting.release() or over.wait(60.0))
    asking = [
        threading.Thread(
            target=httpx.get, args=(f"{server.url}/v1/runs/{number}",), kwargs={"headers": BEARER, **CLIENT}
        )
        for number in range(60)
    ]
    for thread in asking:
        thread.start()
    for _ in range(40):  # as many as there are threads for files
        assert waiting.acquire(timeout=60.0)
    assert is_well(server)
    over.set()
    for thread in asking:
        thread.join()


@pytest.mark.parametrize("what", ["link", "fifo", "directory"])
@pytest.mark.parametrize("name", ["rounds.mp4", "metrics.jsonl", "status.json", "goals.json", "published.json"])
def test_what_is_no_file_of_the_run_is_neither_followed_nor_waited_for(tmp_path, what, name):
    secret = tmp_path / "secret"
    secret.write_text("secret " * 100)
    run = tmp_path / "home" / "runs" / "cube"
    run.mkdir(parents=True)
    (run / "config.yaml").write_text("name: x\nrun: {total_env_steps: 10}\n")
    path = run / name
    {"link": lambda: path.symlink_to(secret), "fifo": lambda: os.mkfifo(path), "directory": path.mkdir}[what]()
    with serve(tmp_path / "home") as server, httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        pages = ("", "/metrics", "/goals", "/files", "/video", f"/files/{name}")
        answers = [client.get(f"/v1/runs/cube{page}") for page in pages] + [client.get("/metrics")]
    assert not any("secret" in answer.text for answer in answers)
    assert answers[0].status_code == 200
    assert {answer.status_code for answer in answers} <= {200, 404, 500, 503}
