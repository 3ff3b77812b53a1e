"""How soon the status page is painted, by a service and a browser that have just started, and the service's memory.

    python -m benchmarks.page_speed --json docs/results/page_speed.json

It writes many runs with long records into a temporary directory, 1.5 GB by default. For each view it starts
``tandem serve`` and Chromium anew, and waits until the last curve is painted; the time counts from the moment at which
the browser is sent to the address. Then it asks one service for the curves of all runs again and again. Nothing else
should run on the machine; CPU times are recorded beside the wall-clock times, on which other programs bear less.
"""

from __future__ import annotations

import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.measuring import ROOT, parser_of, run_benchmark
from benchmarks.processes import cpu_s, resident_bytes
from benchmarks.report.markdown import table
from service.errors import TandemError
from service.store.models import RunStatus

CURVES = (
    "bob/success_rate", "bob/success_rate_air", "alice/lifted_fraction", "alice/valid_fraction",
    "alice/goal_height_m", "time/env_steps_per_s",
)  # fmt: skip
"""Metrics that panels show; the others are there as in a real run, which has some seventy."""
EVALUATED = tuple(f"evaluation/{kind}_success_last" for kind in ("mixed", "air", "table"))
EVALUATION_INTERVAL = 100
NUM_METRICS = 70
NUM_DISTINCT = 5
"""Files that are drawn by chance; the other runs have copies of them, which are read all the same."""
START_S, PAINTED_S = 60.0, 120.0
_BROWSER = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--no-proxy-server",
            "--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage")  # fmt: skip


@dataclass(frozen=True, slots=True)
class PageSettings:
    """Size of the measurement."""

    runs: int = 50
    records: int = 10_000
    compared: int = 5
    repeats: int = 5
    rounds: int = 4


def measure_page(settings: PageSettings) -> dict[str, Any]:
    """Measure the first view, the comparison, and the memory."""
    with tempfile.TemporaryDirectory(prefix="tandem-page-") as name:
        runs = Path(name) / "runs"
        num_bytes = write_runs(runs, settings)
        ids = [f"run-{index}" for index in range(settings.compared)]
        views = {"first view": ("#/", "runs"), "comparing": (f"#/compare/{','.join(ids)}", "curves")}
        measured: dict[str, list[dict[str, float]]] = {view: [] for view in views}
        for _ in range(settings.repeats):
            for view, (place, mark) in views.items():
                measured[view].append(paint(runs, place, mark))
        memory = measure_memory(runs, settings)
    return {
        "num_bytes": num_bytes,
        "views": {view: {key: [each[key] for each in found] for key in found[0]} for view, found in measured.items()},
        "memory": memory,
    }


def write_runs(root: Path, settings: PageSettings) -> int:
    """Write runs that have ended; the bytes of all records."""
    now = datetime.now(UTC)
    for index in range(settings.runs):
        path = root / f"run-{index}"
        path.mkdir(parents=True)
        status = RunStatus(
            run_id=path.name,
            name="panda-cube",
            runtime="local",
            state="finished",
            started=now - timedelta(hours=index + 1),
            heartbeat=now,
            iteration=settings.records,
            num_env_steps=2000 * settings.records,
            total_env_steps=2000 * settings.records,
        )
        (path / "status.json").write_text(status.model_dump_json())
        (path / "config.yaml").write_text(f"name: panda-cube\nseed: {index}\n")
        if index < NUM_DISTINCT:
            _write_records(path / "metrics.jsonl", settings.records, np.random.default_rng(index))
        else:
            shutil.copyfile(root / f"run-{index % NUM_DISTINCT}" / "metrics.jsonl", path / "metrics.jsonl")
    return sum(path.stat().st_size for path in root.glob("*/metrics.jsonl"))


def _write_records(path: Path, number: int, rng: np.random.Generator) -> None:
    time_ = np.linspace(0.0, 1.0, number)
    names = [*CURVES, *(f"learner/some_metric_of_a_run_{index}" for index in range(NUM_METRICS - len(CURVES)))]
    middle = rng.uniform(0.2, 0.6)
    values = 1.0 / (1.0 + np.exp((middle - time_) / 0.06)) + 0.05 * rng.standard_normal((len(names), number))
    with path.open("w") as file:
        for index in range(number):
            record: dict[str, float] = {"iteration": index + 1, "env_steps": 2000 * (index + 1)}
            record |= dict(zip(names, values[:, index].tolist(), strict=True))
            if (index + 1) % EVALUATION_INTERVAL == 0:
                record |= dict.fromkeys(EVALUATED, float(values[0, index]))
            file.write(json.dumps(record) + "\n")


@contextmanager
def serving(runs: Path) -> Iterator[tuple[int, str]]:
    """Start ``tandem serve`` in a process of its own: its pid, and its URL.

    Raises:
        TandemError: it does not start.
    """
    command = [sys.executable, "-u", "-m", "service", "serve", "--runs", str(runs), "--port", "0"]
    command += ["--registry", str(runs.parent / "registry")]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        if "http://" not in line:
            raise TandemError(f"tandem serve does not start: {line.strip()[:300]}")
        url = line[line.rindex("http://") :].strip()
        deadline_s = time.monotonic() + START_S
        while not _answers(url):
            if time.monotonic() > deadline_s:
                raise TandemError(f"{url} does not answer")
            time.sleep(0.02)
        yield process.pid, url
    finally:
        process.terminate()
        process.wait(30)


def _answers(url: str) -> bool:
    try:
        return httpx.get(f"{url}/livez", trust_env=False).is_success
    except httpx.TransportError:
        return False


def paint(runs: Path, place: str, mark: str) -> dict[str, float]:
    """Open the view at ``place`` with a new service and a new browser, until the page sets ``mark``: it is painted.

    Returns:
        Seconds until then, and CPU seconds of the browser's main thread and of the service.
    """
    from playwright.sync_api import sync_playwright

    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        raise TandemError("no chromium on PATH; on Debian: apt-get install chromium")
    with serving(runs) as (service, url), sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(_BROWSER))
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        session = page.context.new_cdp_session(page)
        session.send("Performance.enable")
        before_s = cpu_s(service)
        page.goto(f"{url}/{place}", wait_until="commit")
        deadline_s = time.monotonic() + PAINTED_S
        while (at_ms := page.evaluate(f"performance.getEntriesByName('{mark}')[0]?.startTime")) is None:
            if time.monotonic() > deadline_s:
                raise TandemError(f"{place} is not painted after {PAINTED_S:g} s")
            page.wait_for_timeout(20)
        service_s = cpu_s(service) - before_s
        metrics = {each["name"]: each["value"] for each in session.send("Performance.getMetrics")["metrics"]}
        browser.close()
    return {"painted_s": at_ms / 1000, "browser_cpu_s": metrics["ThreadTime"], "service_cpu_s": service_s}


def measure_memory(runs: Path, settings: PageSettings) -> list[int]:
    """Resident bytes of one service: at first, and after each round in which all curves of all runs were asked for."""
    names = [("names", name) for name in (*CURVES, *EVALUATED)]
    with serving(runs) as (service, url), httpx.Client(base_url=url, trust_env=False, timeout=300.0) as client:
        found = [resident_bytes(service)]
        for _ in range(settings.rounds):
            for first in range(0, settings.runs, settings.compared):
                ids = [
                    ("runs", f"run-{index}") for index in range(first, min(settings.runs, first + settings.compared))
                ]
                client.get("/v1/series", params=[*ids, *names]).raise_for_status()
            client.get("/v1/runs", params={"sparkline": CURVES[0], "limit": 1000}).raise_for_status()
            found.append(resident_bytes(service))
    return found


def report(result: dict[str, Any]) -> str:
    """The measurement as text."""
    rows = [
        (view, *(f"{statistics.median(each[key]):.2f} s" for key in ("painted_s", "browser_cpu_s", "service_cpu_s")))
        for view, each in result["views"].items()
    ]
    memory = ", ".join(f"{num_bytes / 1e6:.0f} MB" for num_bytes in result["memory"])
    return f"{table(('', 'painted after', 'CPU, browser', 'CPU, service'), rows)}\n\nmemory: {memory}"


def main() -> int:
    """Parse the command line and measure."""
    given = parser_of(__doc__, PageSettings()).parse_args()
    return run_benchmark("page_speed", ("plotly", "fastapi", "msgspec"), given, PageSettings, measure_page, report)


if __name__ == "__main__":
    raise SystemExit(main())
