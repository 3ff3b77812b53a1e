"""Debian's nginx with the deployed file in front of a service: attacks from many addresses, and what has to pass."""

import os
import re
import selectors
import shutil
import socket
import subprocess
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import httpx
import pytest

from service.base.ports import free_port
from tests.status.conftest import serve
from tests.status.runs import BEARER, CLIENT, TOKEN

DEPLOYED = Path(__file__).parents[2] / "deploy" / "nginx" / "nginx.conf"
NGINX = shutil.which("nginx", path=f"{os.environ['PATH']}:/usr/sbin")
NUM_CLIENTS = 512
HEAD = b"host: lab.example\r\n"

pytestmark = pytest.mark.skipif(NGINX is None, reason="nginx is not installed; on Debian: apt-get install nginx")


@pytest.fixture(scope="module")
def service(home):
    with serve(home, host="0.0.0.0") as server:
        yield server


@pytest.fixture(scope="module")
def port(service, tmp_path_factory):
    """Port of an nginx with the deployed file: its address, its upstream and its directory are others."""
    directory, port = tmp_path_factory.mktemp("nginx"), free_port("127.0.0.1")
    text = DEPLOYED.read_text()
    for deployed, here, times in (
        (r"\blisten 8000\b", f"listen 127.0.0.1:{port}", 1),
        (r"server status:8321;", f"server 127.0.0.1:{service.port};", 1),
        (r" /tmp/", f" {directory}/", 7),
        (r"error_log stderr;", f"error_log {directory}/log;", 1),
    ):
        text, found = re.subn(deployed, here, text)
        assert found == times, deployed
    (directory / "nginx.conf").write_text(text)
    command = [NGINX, "-c", directory / "nginx.conf", "-e", directory / "log"]
    if directory.owner() == "root":
        command += ["-g", "user root;"]  # its workers may not enter the directory of a test otherwise
    process = subprocess.Popen(command)
    try:
        while not accepts(port):
            assert process.poll() is None
            time.sleep(0.01)
        yield port
    finally:
        process.terminate()
        process.wait(300)
    assert not re.search(r"\[(emerg|alert|crit)\]", (directory / "log").read_text())
    assert process.returncode == 0


@pytest.fixture
def client(port):
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", **CLIENT) as client:
        yield client


@pytest.fixture
def crowd(port):
    """Makes connections, each from an address of its own if there are several."""
    with ExitStack() as stack:

        def connect(number=1, *, source=None, data=b""):
            made = []
            for index in range(number):
                address = source or f"127.1.{index // 250}.{1 + index % 250}"
                connection = socket.create_connection(("127.0.0.1", port), 60.0, (address, 0))
                made.append(stack.enter_context(connection))
                with suppress(ConnectionError):  # refused before it had all
                    connection.sendall(data)
            return made

        yield connect


def accepts(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def received(connection):
    """All bytes until nginx closes."""
    data = b""
    with suppress(ConnectionResetError):
        while piece := connection.recv(1 << 20):
            data += piece
    return data


def assert_others_are_served(client, service):
    assert client.get("/livez").status_code == 200
    assert client.get("/v1/runs", headers=BEARER).status_code == 200
    assert len(client.get("/page/plotly.js").content) > 1_000_000
    assert len(service._server.server_state.connections) < 10  # the others have not even reached it


# --- attacks ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "request_",
    [
        b"GET /page/plotly.js HTTP/1.1\r\n" + HEAD + b"\r\n",
        b"POST /v1/session HTTP/1.1\r\n" + HEAD + b"content-length: 100\r\n\r\n{",
        b"GET /livez HTTP/1.1\r\n" + HEAD + b"x: ",
    ],
    ids=["answer not read", "half a body", "half a head"],
)
def test_clients_that_do_not_go_on(client, service, crowd, request_):
    crowd(NUM_CLIENTS, data=request_)
    assert_others_are_served(client, service)


def test_a_head_that_is_too_large(client, service, crowd):
    """The service itself would take it."""
    head = b"GET /livez HTTP/1.1\r\n" + HEAD + b"connection: close\r\n" + (b"x: " + b"a" * 5000 + b"\r\n") * 10
    (connection,) = crowd(data=head + b"\r\n")
    assert received(connection)[:12] in (b"HTTP/1.1 400", b"")  # or the answer was lost, as nginx had closed
    assert_others_are_served(client, service)


def test_one_address_has_only_so_many_connections(client, service, crowd):
    half = b"POST /v1/session HTTP/1.1\r\n" + HEAD + b"content-length: 100\r\n\r\n{"
    refused = set()
    with selectors.DefaultSelector() as held:
        for connection in crowd(200, source="127.2.0.1", data=half):
            held.register(connection, selectors.EVENT_READ)
        while len(refused) < 200 - 128:
            refused |= {key.fileobj for key, _ in held.select(60.0)}
    assert all(connection.recv(12) == b"HTTP/1.1 429" for connection in refused)
    assert_others_are_served(client, service)


def test_one_address_asks_only_so_often(client, service, crowd):
    request = b"GET /page/icon.svg HTTP/1.1\r\n" + HEAD
    (connection,) = crowd(source="127.2.0.2", data=(request + b"\r\n") * 999 + request + b"connection: close\r\n\r\n")
    answers = received(connection)
    assert answers.count(b"HTTP/1.1 200") >= 400
    assert answers.count(b"HTTP/1.1 429") >= 100
    assert_others_are_served(client, service)


def test_slow_clients_are_ended(port, crowd):
    """The only wait for a clock: it takes the ten seconds that the file gives them."""
    (no_head,) = crowd(data=b"GET /livez HTTP/1.1\r\nx: ")
    (no_body,) = crowd(data=b"POST /v1/session HTTP/1.1\r\n" + HEAD + b"content-length: 100\r\n\r\n{")
    (no_reader,) = crowd(data=b"GET /page/plotly.js HTTP/1.1\r\n" + HEAD + b"\r\n")
    for connection in (no_head, no_body, no_reader):
        connection.settimeout(40.0)  # in which nginx has to end it
    assert received(no_head)[:12] in (b"", b"HTTP/1.1 408")
    assert received(no_body)[:12] in (b"", b"HTTP/1.1 408")
    size = int(httpx.head(f"http://127.0.0.1:{port}/page/plotly.js", **CLIENT).headers["content-length"])
    assert len(received(no_reader)) < size


# --- what has to pass ------------------------------------------------------------------------------------------------


def test_nobody_passes_without_the_token(client):
    assert client.get("/v1/runs").json()["type"] == "urn:tandem:missing-token"
    assert client.get("/metrics").status_code == 401
    assert client.get("/metrics", headers=BEARER).status_code == 200
    assert client.post("/v1/runs/old/stop").status_code == 401
    assert client.post("/v1/runs/old/stop", headers=BEARER).status_code == 202


@pytest.mark.parametrize(("outer", "is_secure"), [(None, False), ("http", False), ("https", True)])
def test_a_session_is_for_tls_only_where_there_is_tls(client, outer, is_secure):
    headers = {"X-Forwarded-Proto": outer} if outer else {}
    answer = client.post("/v1/session", json={"token": TOKEN}, headers=headers)
    cookie = answer.headers["set-cookie"]
    assert ("; secure" in cookie.lower()) == is_secure
    assert client.get("/v1/runs", headers={"Cookie": cookie.partition(";")[0]}).status_code == 200


def test_events_come_when_they_happen(client):
    with client.stream("GET", "/v1/runs/cube/metrics/stream", headers=BEARER) as answer:
        first = next(answer.iter_text())  # the run goes on, and so does the stream
    assert first.startswith("retry:")


def test_a_body_that_is_too_large(client):
    answer = client.put("/v1/primitives/tiny/aliases/best", content=b" " * 70_000, headers=BEARER)
    assert (answer.status_code, answer.headers["content-type"]) == (413, "text/html")  # nginx's own
