"""Asks the status service so many times a second, whether it keeps up or not; started by ``rest_load.py``.

    python -m benchmarks.open_loop 127.0.0.1:8321 RUN_ID --rate 200 --seconds 30

Requests have a fixed schedule. How long one took counts from when it was due, so a service that cannot answer for a
second is not asked less in that second, and each request that was kept waiting counts. One line of JSON comes out.
Only the standard library is used, so that it takes little of the cores that it shares with what it measures.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPException
from itertools import count, cycle, islice

ROUTES = {
    "run": "/v1/runs/{run}",
    "runs": "/v1/runs",
    "metrics": "/v1/runs/{run}/metrics?max_points=300&names=bob/success_rate&names=alice/valid_fraction",
    "goals": "/v1/runs/{run}/goals",
    "primitives": "/v1/primitives",
    "prometheus": "/metrics",
}
MIX = ("run", "metrics", "runs", "run", "goals", "primitives", "run", "metrics", "prometheus", "primitives")
"""Over and over."""
NUM_CONNECTIONS = 32
"""So many requests may be on their way before the next one has to wait for the client."""
TIMEOUT_S = 10.0
_LEAD_S = 0.2
_SWITCH_S = 0.0005
"""Between two threads of Python; with the usual 5 ms, long answers would hold up others in the client."""


class Load:
    """Sends requests on schedule from ``NUM_CONNECTIONS`` threads.

    Args:
        address: of the service, ``HOST:PORT``.
        run_id: whom to ask about.
        rate: requests a second.
        seconds: how long.
    """

    def __init__(self, address: str, run_id: str, rate: float, seconds: float) -> None:
        host, _, port = address.rpartition(":")
        self._host, self._port, self._run_id, self._rate = host, int(port), run_id, rate
        num = round(rate * seconds)
        self._line: Iterator[tuple[int, str]] = iter(list(zip(count(), islice(cycle(MIX), num), strict=False)))
        self._lock = threading.Lock()
        self.took: dict[str, list[float]] = {route: [] for route in ROUTES}
        """Milliseconds from when a request was due until its answer was there."""
        self.late: list[float] = []
        """Milliseconds from when a request was due until the client sent it."""
        self.num_failed = 0

    def run(self) -> None:
        """Until the last answer."""
        self.start = time.time() + _LEAD_S
        self._due = time.perf_counter() + _LEAD_S
        threads = [threading.Thread(target=self._work) for _ in range(NUM_CONNECTIONS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        self.end = time.time()

    def _work(self) -> None:
        connection = HTTPConnection(self._host, self._port, timeout=TIMEOUT_S)
        while (place := self._next()) is not None:
            index, route = place
            due = self._due + index / self._rate
            time.sleep(max(0.0, due - time.perf_counter()))
            sent = time.perf_counter()
            answered = self._ask(connection, ROUTES[route].format(run=self._run_id))
            done = time.perf_counter()
            with self._lock:
                self.late.append(1000.0 * (sent - due))
                self.took[route].append(1000.0 * (done - due))
                self.num_failed += not answered
        connection.close()

    def _next(self) -> tuple[int, str] | None:
        with self._lock:
            return next(self._line, None)

    def _ask(self, connection: HTTPConnection, path: str) -> bool:
        try:
            connection.request("GET", path)
            response = connection.getresponse()
            response.read()
        except (OSError, HTTPException):
            connection.close()
            return False
        return response.status == 200


def main() -> None:
    """Ask, and print what it took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address", metavar="HOST:PORT")
    parser.add_argument("run_id")
    parser.add_argument("--rate", type=float, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    given = parser.parse_args()
    sys.setswitchinterval(_SWITCH_S)
    load = Load(given.address, given.run_id, given.rate, given.seconds)
    load.run()
    found = {"start": load.start, "end": load.end, "cpu_s": time.process_time(), "num_failed": load.num_failed}
    print(json.dumps({**found, "took_ms": load.took, "late_ms": load.late}))


if __name__ == "__main__":
    main()
