"""What a client can do before anybody has seen a token: take neither memory nor the service's time."""

import os
import socket
import threading
from contextlib import suppress
from pathlib import Path

import httpx
import pytest

from service.status import server as module
from service.store.disk_reader import DiskReader
from tests.status.conftest import serve
from tests.status.runs import BEARER, CLIENT
from tests.store.stores import wait_until


def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture
def server(home):
    with serve(home) as server:
        yield server


def connect(server):
    return socket.create_connection(("127.0.0.1", server.port), timeout=60.0)


def is_well(server):
    return httpx.get(f"{server.url}/livez", **CLIENT).status_code == 200


def send_all(connection, piece, times):
    for _ in range(times):
        connection.sendall(piece)


def send_until_full(connection, piece):
    """Send until the buffers of the kernel are full and nothing reads on; returns the number of bytes."""
    num_bytes = 0
    connection.settimeout(1.0)
    with suppress(TimeoutError):
        while num_bytes < 150e6:
            num_bytes += connection.send(piece)
    return num_bytes


def test_requests_that_come_faster_than_their_answers_are_read_take_no_memory(server):
    requests = b"GET / HTTP/1.1\r\nhost: localhost\r\n\r\n" * 1000
    before = resident_bytes()
    with connect(server) as connection:
        assert send_until_full(connection, requests) > 1e6
        assert resident_bytes() - before < 40e6
        assert is_well(server)


def test_a_head_that_is_too_large_is_refused_before_it_is_whole(server):
    with connect(server) as connection:
        connection.sendall(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n")
        with pytest.raises(ConnectionError):
            send_all(connection, b"x: " + b"a" * 5000 + b"\r\n", times=10_000)
    assert is_well(server)


def test_of_more_connections_than_may_be_a_request_is_refused_and_served_when_they_are_gone(home, monkeypatch):
    monkeypatch.setattr(module, "MAX_CONNECTIONS", 4)
    with serve(home) as server:
        held = [connect(server) for _ in range(4)]
        assert httpx.get(f"{server.url}/livez", **CLIENT).status_code == 503
        for connection in held:
            connection.close()
        wait_until(lambda: is_well(server))


def test_it_is_alive_while_every_thread_waits_for_a_file(server, monkeypatch):
    waiting, over = threading.Semaphore(0), threading.Event()
    monkeypatch.setattr(DiskReader, "run", lambda *_: waiting.release() or over.wait(60.0))
    client = httpx.Client(base_url=server.url, headers=BEARER, **CLIENT)
    asking = [threading.Thread(target=client.get, args=(f"/v1/runs/{number}",)) for number in range(60)]
    for thread in asking:
        thread.start()
    for _ in range(40):  # as many as there are threads for files
        assert waiting.acquire(timeout=60.0)
    assert is_well(server)
    over.set()
    for thread in asking:
        thread.join()
    client.close()


@pytest.mark.parametrize("what", ["link", "fifo", "directory"])
def test_what_is_no_file_of_the_run_is_neither_followed_nor_waited_for(tmp_path, what):
    secret = tmp_path / "secret"
    secret.write_text("secret " * 100)
    make = {"link": lambda path: path.symlink_to(secret), "fifo": os.mkfifo, "directory": os.mkdir}[what]
    home, names = tmp_path / "home", ("rounds.mp4", "metrics.jsonl", "status.json", "goals.json", "published.json")
    for name in names:
        run = home / "runs" / name.partition(".")[0]
        run.mkdir(parents=True)
        (run / "config.yaml").write_text("name: x\nrun: {total_env_steps: 10}\n")
        make(run / name)
    with serve(home) as server, httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        for name in names:
            pages = ("", "/metrics", "/goals", "/files", "/video", f"/files/{name}")
            answers = [client.get(f"/v1/runs/{name.partition('.')[0]}{page}") for page in pages]
            assert not any("secret" in answer.text for answer in answers)
            assert answers[0].status_code == 200
            assert {answer.status_code for answer in answers} <= {200, 404, 500, 503}
        assert client.get("/metrics").status_code == 200
