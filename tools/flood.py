"""Flood a status service: thousands of connections that never finish a request, then headers without end.

    python -m tools.flood --json docs/results/flood.json

A service of its own, ``tandem serve``, with one finished run. While the flood comes from another process, which gives
way to it (``nice``) as another machine would, ``livez`` is asked 20 times a second, and the service's memory is read.
"""

from __future__ import annotations

import json
import selectors
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any

from benchmarks.measuring import ROOT, parser_of, run_benchmark
from benchmarks.report.attacks import flood_table
from benchmarks.training_process import environment, scratch
from tools.rest_load import percentiles

EVERY_S = 0.05
_HALF = b"GET /v1/runs HTTP/1.1\r\nhost: localhost\r\nx: "
_LINE = b"x: " + b"a" * 4000 + b"\r\n"


@dataclass(frozen=True, slots=True)
class Settings:
    """Size of the flood."""

    num_half_open: int = 3000
    header_mb: float = 200.0
    hold_s: float = 15.0
    """Half-open connections are held for so long; the service gives them ten seconds."""
    calm_s: float = 5.0
    """Without a flood, before and after each."""


class Service:
    """A ``tandem serve`` of its own, and what is seen of it.

    Args:
        home: for its runs.
    """

    def __init__(self, home: Path) -> None:
        (home / "runs").mkdir()
        command = [sys.executable, "-m", "service", "serve", "--port", "0", "--runs", str(home / "runs")]
        self._process = subprocess.Popen(
            [*command, "--registry", str(home / "registry")], cwd=ROOT, env=environment(home), stdout=subprocess.PIPE,
            text=True,
        )  # fmt: skip
        assert self._process.stdout is not None
        self.port = int(self._process.stdout.readline().strip().rpartition(":")[2].strip("/"))

    def memory_mb(self) -> float:
        """Its memory without libraries and files."""
        text = Path(f"/proc/{self._process.pid}/status").read_text()
        return int(text.partition("RssAnon:")[2].split()[0]) / 1000.0

    def close(self) -> None:
        """End it."""
        self._process.terminate()
        self._process.wait()


class Looks:
    """Asks ``livez`` again and again, each time over a connection of its own, from a thread.

    Args:
        service: that is asked.
    """

    def __init__(self, service: Service) -> None:
        self.took_ms: list[float] = []
        self.num_failed = 0
        self.memory_mb = 0.0
        self._service, self._over = service, threading.Event()
        self._thread = threading.Thread(target=self._work)

    def __enter__(self) -> Looks:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()

    def _work(self) -> None:
        while not self._over.wait(EVERY_S):
            begun = time.perf_counter()
            self.num_failed += not _is_alive(self._service.port)
            self.took_ms.append(1000.0 * (time.perf_counter() - begun))
            self.memory_mb = max(self.memory_mb, self._service.memory_mb())


def _is_alive(port: int) -> bool:
    connection = HTTPConnection("127.0.0.1", port, timeout=10.0)
    try:
        connection.request("GET", "/livez")
        return connection.getresponse().status == 200
    except (OSError, HTTPException):
        return False
    finally:
        connection.close()


def half_open(port: int, num: int, hold_s: float) -> dict[str, int]:
    """Open so many connections, send half a request on each, and hold them; the service may close them."""
    open_ones = []
    for _ in range(num):
        with suppress(OSError):
            connection = socket.create_connection(("127.0.0.1", port), timeout=10.0)
            open_ones.append(connection)
            connection.sendall(_HALF)
    time.sleep(hold_s)
    for connection in open_ones:
        connection.close()
    return {"num_opened": len(open_ones)}


def endless_headers(port: int, num_bytes: int) -> dict[str, int]:
    """Send headers over connection after connection, 50 at a time, as long as the service takes them."""
    sent, num = 0, 0
    with selectors.DefaultSelector() as chosen:
        while sent < num_bytes:
            while len(chosen.get_map()) < 50:
                connection = socket.create_connection(("127.0.0.1", port), timeout=10.0)
                connection.setblocking(False)
                chosen.register(connection, selectors.EVENT_WRITE)
                num += 1
                with suppress(OSError):
                    sent += connection.send(b"GET /livez HTTP/1.1\r\n")
            for key, _ in chosen.select(1.0):
                connection = key.fileobj  # type: ignore[assignment]
                try:
                    sent += connection.send(_LINE)
                except OSError:  # closed by the service
                    chosen.unregister(connection)
                    connection.close()
        for key in list(chosen.get_map().values()):
            key.fileobj.close()  # type: ignore[union-attr]
    return {"num_opened": num, "num_bytes": sent}


@contextmanager
def _flooding(call: str) -> Iterator[subprocess.Popen[str]]:
    """A process that gives way, and prints what a call of a function of this module returns."""
    code = f"import json, os; from tools.flood import *; os.nice(15); print(json.dumps({call}))"
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def measure(settings: Settings) -> dict[str, Any]:
    """Flood a service twice; latencies in ms, memory in MB."""
    result: dict[str, Any] = {}
    with scratch() as home:
        service = Service(home)
        floods = {
            "half_open": f"half_open({service.port}, {settings.num_half_open}, {settings.hold_s})",
            "endless_headers": f"endless_headers({service.port}, {round(1e6 * settings.header_mb)})",
        }
        try:
            for kind, call in floods.items():
                with Looks(service) as before:
                    time.sleep(settings.calm_s)
                with Looks(service) as meanwhile, _flooding(call) as process:
                    said, _ = process.communicate()
                with Looks(service) as after:
                    time.sleep(settings.calm_s)
                result[kind] = {
                    **json.loads(said),
                    "memory_mb": {"before": before.memory_mb, "most": meanwhile.memory_mb, "after": after.memory_mb},
                    "livez": percentiles(meanwhile.took_ms), "livez_calm": percentiles(before.took_ms),
                    "num_failed": meanwhile.num_failed + after.num_failed,
                }  # fmt: skip
        finally:
            service.close()
    return result


def main() -> int:
    """Parse the command line, flood, print."""
    given = parser_of(__doc__, Settings()).parse_args()
    return run_benchmark("flood", ("uvicorn", "httptools"), given, Settings, measure, flood_table)


if __name__ == "__main__":
    raise SystemExit(main())
