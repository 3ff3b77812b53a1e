"""Several status services on one machine: each finds a port, unless it was told which."""

import socket
from contextlib import contextmanager

import pytest

from service.base.ports import DEFAULT_PORT, choose_port, free_port, url_of
from service.cluster.ray_connection import StatusOptions, parse_status
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
    monkeypatch.setattr("service.status.server.StatusServer.run", lambda server, is_over: server.stop())
    with caplog.at_level("INFO"):
        result = tandem("serve")
    assert result.exit_code == 0, result.output
    chosen = int(result.stdout.splitlines()[0].rpartition(":")[2])
    assert busy < chosen < busy + 50
    assert f"port {busy} is taken, so the status service is at port {chosen}" in caplog.messages
    assert_refused(tandem("serve", "--port", busy), f"port {busy} of 127.0.0.1 is taken")


@pytest.mark.parametrize(("port", "other"), [(7, "127.0.0.1"), (0, "203.0.113.7"), (None, "203.0.113.7")])
def test_what_is_wrong_with_a_port_or_a_host_is_said_where_the_service_begins(port, other):
    assert choose_port(other, port) == (DEFAULT_PORT if port is None else port)


def test_a_port_is_chosen(busy, caplog):
    with caplog.at_level("INFO"):
        assert choose_port("127.0.0.1", busy) == busy
        assert choose_port("127.0.0.1", 0) > 1023
        assert caplog.messages == []
        found = choose_port("127.0.0.1", None)
    assert busy < found < busy + 50
    assert caplog.messages == [f"port {busy} is taken, so the status service is at port {found}"]


def test_a_run_on_ray_takes_the_usual_port_or_the_next():
    assert parse_status(None, "secret") == StatusOptions("127.0.0.1", None, "secret")
    assert parse_status("::1:7", None) == StatusOptions("::1", 7)
