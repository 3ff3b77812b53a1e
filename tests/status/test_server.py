"""Starting, stopping, and the command ``tandem serve``."""

import os
import re
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import httpx
import pytest

from service.base.errors import StatusError
from service.registry.registry import Registry
from service.registry.token import read_token
from service.status.server import StatusServer
from service.store.disk_reader import DiskReader
from tests.cli.typed import assert_refused, tandem
from tests.status.conftest import serve
from tests.status.runs import BEARER, CLIENT, TOKEN, publish, write_runs

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.usefixtures("default_signals")


def test_port_0_gives_a_free_port(home):
    with serve(home) as server:
        assert server.port != 0
        assert server.url == f"http://127.0.0.1:{server.port}"
        assert httpx.get(f"{server.url}/livez", **CLIENT).status_code == 200


@pytest.mark.skipif(not socket.has_ipv6, reason="this Python was built without IPv6")
def test_ipv6(home):
    try:
        server = serve(home, host="::1", token=None)
    except StatusError:
        pytest.skip("this machine has no IPv6 loopback, ::1")
    with server:
        assert server.url == f"http://[::1]:{server.port}"
        assert httpx.get(f"{server.url}/v1/runs", **CLIENT).status_code == 200


def test_stopping_frees_the_port_and_ends_the_thread(home):
    num_threads = threading.active_count()
    server = serve(home)
    server.start()
    server.stop()
    server.stop()
    assert threading.active_count() <= num_threads + 1  # one of the pool that answers may wait for more to do
    with socket.socket() as again:
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind(("127.0.0.1", server.port))


def test_a_port_that_is_taken(home):
    with serve(home) as server, pytest.raises(StatusError) as error:
        StatusServer(DiskReader(home), Registry(home), port=server.port)
    assert str(error.value) == (
        f"port {server.port} of 127.0.0.1 is taken; stop what listens there, or choose another with --port"
    )


@pytest.mark.parametrize("host", ["no-such-host.invalid", "203.0.113.7", "", "a b", "x" * 300])
def test_a_host_of_another_machine(home, host):
    with pytest.raises(StatusError) as error:
        serve(home, host=host, token=None)
    assert "\n" not in str(error.value)


def test_tokens(tmp_path, monkeypatch):
    monkeypatch.delenv("TANDEM_TOKEN", raising=False)
    assert read_token() is None
    monkeypatch.setenv("TANDEM_TOKEN", f" {TOKEN}\n")
    assert read_token() == TOKEN
    file = tmp_path / "token"
    file.write_text("0123456789abcdef-of-a-file\n")
    assert read_token(file) == "0123456789abcdef-of-a-file"


@pytest.mark.parametrize("content", [None, b"", b"short", b"two words are no token", b"\xff" * 30, b"a" * 20 + b"\x00"])
def test_a_file_without_a_token(tmp_path, content):
    file = tmp_path / "token"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(StatusError) as error:
        read_token(file)
    assert str(error.value).startswith(f"--token-file {file}")
    assert "\n" not in str(error.value)
    assert not content or content.decode("latin-1") not in str(error.value)


# --- the command ----------------------------------------------------------------------------------------------------


def command(*arguments, **environment):
    clean = {name: value for name, value in os.environ.items() if not name.startswith("TANDEM_")}
    return subprocess.Popen(
        [sys.executable, "-m", "service", "serve", *map(str, arguments)],
        cwd=ROOT,
        env={**clean, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP], ids=lambda number: number.name)
def test_the_command(tmp_path, number):
    write_runs(tmp_path / "runs")
    publish(Registry(tmp_path / "registry"))
    (tmp_path / "token").write_text(TOKEN)
    paths = ("--runs", tmp_path / "runs", "--registry", tmp_path / "registry")
    process = command(*paths, "--port", 0, "--token-file", tmp_path / "token")
    try:
        first = process.stdout.readline()
        url = re.search(r"http://\S+", first)[0]
        with httpx.Client(base_url=url, **CLIENT) as client:
            assert {run["run_id"] for run in client.get("/v1/runs").json()["runs"]} == {"cube", "old"}
            assert client.get("/v1/primitives/tiny").json()["newest"] == 1
            assert client.get("/v1/runs/old/video").status_code == 200
            assert client.post("/v1/runs/cube/stop").status_code == 401
            assert client.post("/v1/runs/cube/stop", headers=BEARER).status_code == 202
        process.send_signal(number)
        rest, _ = process.communicate(timeout=600)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, rest
    assert TOKEN not in first + rest
    assert "Traceback" not in rest


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--runs", "no/such/runs"], ["no directory no/such/runs", "--runs"]),
        (["--runs", "service", "--host", "0.0.0.0"], ["no token", "TANDEM_TOKEN", "--token-file"]),
        (["--runs", "service", "--token-file", "no/token"], ["--token-file no/token", "No such file"]),
    ],
)
def test_one_clear_error(arguments, parts, monkeypatch):
    monkeypatch.delenv("TANDEM_TOKEN", raising=False)
    assert_refused(tandem("serve", *arguments, "--port", "0"), *parts)


def test_it_serves_the_directory_in_which_tandem_train_makes_runs():
    assert_refused(tandem("serve", "--port", "0", TANDEM_RUNS="no/such/runs"), "no directory no/such/runs")


def test_a_token_is_never_on_the_command_line():
    result = tandem("serve", "--help", NO_COLOR="1", COLUMNS="120")
    assert re.findall(r"--[a-z-]*token[a-z-]*", result.stdout) == ["--token-file"]
