"""Several status services on one machine: each finds a port, unless it was told which."""

import socket
from contextlib import contextmanager

import pytest

from service.base.ports import DEFAULT_PORT, free_port, url_of
from service.cluster.ray_connection import StatusOptions, parse_status
from service.cluster.status_actor import place
from tests.cli.typed import assert_refused, tandem


@contextmanager
def taken(port=0):
    """A port that somebody listens at."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", port))
        other.listen()
        yield other.getsockname()[1]


@pytest.fixture
def busy(monkeypatch):
    """The usual port, which is taken."""
    with taken() as port:
        monkeypatch.setattr("service.base.ports.DEFAULT_PORT", port)
        yield port


def test_the_next_free_port():
    with taken() as port:
        found = free_port("127.0.0.1", port)
        assert port < found < port + 50
        with taken(found):
            assert free_port("127.0.0.1", port) > found
    assert free_port("127.0.0.1", port) == port
    assert free_port("127.0.0.1") > 1023
    assert free_port("::1") > 1023
    with pytest.raises(OSError, match="no name of a host"):
        free_port("127.0.0..1")


def test_a_url_leads_to_what_listens_at_all_addresses():
    assert url_of("lab", 8321) == "http://lab:8321"
    assert [url_of(host, 1) for host in ("", "0.0.0.0")] == ["http://127.0.0.1:1"] * 2
    assert [url_of(host, 1) for host in ("::", "::1")] == ["http://[::1]:1"] * 2


def test_serve_takes_the_next_one_unless_told_which(tmp_path, monkeypatch, busy, caplog):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    monkeypatch.setattr("service.status.server.StatusServer.run", lambda server: server.stop())
    with caplog.at_level("INFO"):
        result = tandem("serve")
    assert result.exit_code == 0, result.output
    chosen = int(result.stdout.splitlines()[0].rpartition(":")[2])
    assert busy < chosen < busy + 50
    assert f"port {busy} is taken, so this is at port {chosen}" in caplog.messages
    assert_refused(tandem("serve", "--port", busy), f"port {busy} of 127.0.0.1 is taken")


def test_a_run_on_ray_does_the_same(caplog):
    assert parse_status(None, "secret") == StatusOptions("127.0.0.1", DEFAULT_PORT, "secret", or_next=True)
    with taken() as port, caplog.at_level("INFO"):
        placed = place(StatusOptions(port=port, or_next=True))
        assert port < placed.port < port + 50
        assert caplog.messages == [f"port {port} is taken, so the status service is at port {placed.port}"]
        named = StatusOptions(port=port)
        assert place(named) == named  # which fails when it is started
