"""Ask the status service so many times a second, whether it keeps up or not, and print its latencies.

    python -m tools.rest_load 127.0.0.1:8321 RUN_ID --rate 200 --seconds 20

Requests have a fixed schedule. The time of one counts from when it was due, so a service that cannot answer for a
second is not asked less in that second, and each request that was kept waiting counts. It takes little of the cores
that it may share with what it measures.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException
from itertools import count, cycle, islice
from typing import Any

import numpy as np

from benchmarks.measuring import parser_of, run_benchmark
from benchmarks.report.cluster import latency_table

ROUTES = {
    "run": "/v1/runs/{run}",
    "runs": "/v1/runs",
    "metrics": "/v1/runs/{run}/metrics?max_points=300&names=bob/success_rate&names=alice/valid_fraction",
    "goals": "/v1/runs/{run}/goals",
    "primitives": "/v1/primitives",
    "prometheus": "/metrics",
}
MIX = ("run", "metrics", "runs", "run", "goals", "primitives", "run", "metrics", "prometheus", "primitives")
"""Order of the routes, over and over."""
NUM_CONNECTIONS = 32
"""Most requests on their way before the next one has to wait for the client."""
TIMEOUT_S = 10.0
PERCENTILES = {"p50_ms": 0.5, "p90_ms": 0.9, "p99_ms": 0.99, "max_ms": 1.0}
_LEAD_S = 0.2
_SWITCH_S = 0.0005
"""Between two threads of Python; with the usual 5 ms, long answers would hold up others in the client."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of load."""

    rate: float = 200.0
    """Requests a second."""
    seconds: float = 20.0


class Load:
    """Sends requests on schedule from ``NUM_CONNECTIONS`` threads.

    Args:
        address: of the service, ``HOST:PORT``.
        run_id: of the run to ask about.
        settings: rate and length of the schedule.
    """

    def __init__(self, address: str, run_id: str, settings: Settings) -> None:
        host, _, port = address.rpartition(":")
        self._host, self._port, self._run_id, self._rate = host, int(port), run_id, settings.rate
        num = round(settings.rate * settings.seconds)
        self._line = iter(list(zip(count(), islice(cycle(MIX), num), strict=False)))
        self._lock = threading.Lock()
        self.took: dict[str, list[float]] = {route: [] for route in ROUTES}
        """Milliseconds from when a request was due until its answer was there."""
        self.late: list[float] = []
        """Milliseconds from when a request was due until the client sent it."""
        self.num_failed = 0
        self.seconds = 0.0
        """From the first request that was due to the last answer."""

    def run(self) -> None:
        """Send everything and wait for the last answer."""
        self._due = time.perf_counter() + _LEAD_S
        threads = [threading.Thread(target=self._work) for _ in range(NUM_CONNECTIONS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        self.seconds = time.perf_counter() - self._due

    def result(self) -> dict[str, Any]:
        """Latencies by route, for JSON."""
        took = {**self.took, "all": [value for values in self.took.values() for value in values]}
        return {
            "requests_per_s": len(took["all"]) / self.seconds,
            "num_failed": self.num_failed,
            "answered": {route: percentiles(values) for route, values in took.items() if values},
            "sent_late_p99_ms": percentiles(self.late)["p99_ms"],
        }

    def _work(self) -> None:
        connection = HTTPConnection(self._host, self._port, timeout=TIMEOUT_S)
        while (place := self._next()) is not None:
            index, route = place
            due = self._due + index / self._rate
            time.sleep(max(0.0, due - time.perf_counter()))
            sent = time.perf_counter()
            answered = _ask(connection, ROUTES[route].format(run=self._run_id))
            done = time.perf_counter()
            with self._lock:
                self.late.append(1000.0 * (sent - due))
                self.took[route].append(1000.0 * (done - due))
                self.num_failed += not answered
        connection.close()

    def _next(self) -> tuple[int, str] | None:
        with self._lock:
            return next(self._line, None)


def _ask(connection: HTTPConnection, path: str) -> bool:
    try:
        connection.request("GET", path)
        response = connection.getresponse()
        response.read()
    except (OSError, HTTPException):
        connection.close()
        return False
    return response.status == 200


def percentiles(values: Sequence[float]) -> dict[str, float]:
    """Number of values and some percentiles, each a value that was measured."""
    found = {name: np.quantile(values, share, method="inverted_cdf") for name, share in PERCENTILES.items()}
    return {"num": len(values), **{name: round(float(value), 3) for name, value in found.items()}}


def main() -> int:
    """Parse the command line, ask, print."""
    parser = parser_of(__doc__, Settings())
    parser.add_argument("address", metavar="HOST:PORT")
    parser.add_argument("run_id")
    given = parser.parse_args()
    sys.setswitchinterval(_SWITCH_S)

    def benchmark(settings: Settings) -> dict[str, Any]:
        load = Load(given.address, given.run_id, settings)
        load.run()
        return load.result()

    return run_benchmark("latencies", (), given, Settings, benchmark, latency_table)


if __name__ == "__main__":
    raise SystemExit(main())
