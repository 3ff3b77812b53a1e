"""What 200 requests a second to the status service cost a running training, and how fast they are answered.

    python -m benchmarks.rest_load --run-dir runs/cube --json docs/results/rest_load.json

A copy of a run goes on with ``--runtime ray``, with its whole history and the primitives that come with the package
in its registry. Windows without and with requests take turns, A B A B ... A, and each B is compared with the mean of
the two A around it, so that a training which gets slower or faster by itself does not count. Checkpoints and
evaluations are left out: one that fell into a window would be its whole difference.

The client is a process of its own (``open_loop.py``) on the same cores. What it takes, the training lacks; in
operation it runs elsewhere. So beside the slow-down as it was measured stands the CPU time that the service itself
took, as a share of all cores: what the load would cost a training that has all of them busy.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from benchmarks.estimates import percentile
from benchmarks.measuring import describe, machine, write_json
from benchmarks.open_loop import ROUTES
from benchmarks.processes import cpu_s
from benchmarks.trainings import ENDLESS, ROOT, Training, copy_run, overrides, scratch
from service.errors import TandemError
from service.io.checkpoints import CheckpointStore
from service.io.jsonl import read_jsonl
from service.io.run_directory import RunDirectory
from service.store.redis_writer import RedisWriter
from tests.store.redis_server import RedisServer

PACKAGES = ("ray", "redis", "fastapi", "uvicorn", "mujoco", "torch")
NUM_WARMUP_ITERATIONS = 4
WARMUP_S = 3.0
"""Of requests, before the first window: the service reads the run's history."""
LOOK_S = 0.05
SERVICE_ROLES = ("status", "redis")


@dataclass(frozen=True, slots=True)
class Settings:
    """How much is measured."""

    rate: float = 200.0
    """Requests a second."""
    window_s: float = 30.0
    num_windows: int = 8
    """With requests; one more without."""
    num_actors: int = 0
    """0: as many as there are cores."""


@dataclass(frozen=True, slots=True)
class Window:
    """Some seconds of a training."""

    start: float
    """Seconds since 1970, as ``end``."""
    end: float
    cores: dict[str, float]
    """CPU seconds a second, by role of process."""
    answers: dict[str, Any] | None = None
    """Of the client; None: nobody asked."""

    @property
    def seconds(self) -> float:
        """How long."""
        return self.end - self.start


class Progress:
    """When a run finished how many env steps, from its records as it writes them."""

    def __init__(self, file: Path) -> None:
        self._file, self._tail = file, b""
        self._offset = file.stat().st_size
        self.times: list[float] = []
        self.steps: list[float] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Look no longer."""
        self._ended.set()
        self._thread.join()

    def rate(self, start: float, end: float) -> float:
        """Env steps a second; between two iterations they are taken to grow evenly."""
        first, last = np.interp([start, end], self.times, self.steps)
        return float(last - first) / (end - start)

    def _watch(self) -> None:
        while not self._ended.wait(LOOK_S):
            if self._file.stat().st_size == self._offset:
                continue
            now = time.time()
            with self._file.open("rb") as file:
                file.seek(self._offset)
                new = file.read()
            self._offset += len(new)
            *lines, self._tail = (self._tail + new).split(b"\n")
            for line in lines:
                self.times.append(now)
                self.steps.append(float(json.loads(line)["env_steps"]))


def slow_down(rates: Sequence[float]) -> dict[str, Any]:
    """How much slower each window with load is than the mean of the windows before and after it.

    Args:
        rates: env steps a second without load, with, without, with, ..., without.

    Returns:
        Median, least and greatest of ``1 - rate / mean of both neighbours``, their mean with its standard error (None
        for a single one), and how much neighbours without load differ, measured alike: what chance makes of it.
    """
    assert len(rates) >= 3, "a window with load has two neighbours"
    assert len(rates) % 2 == 1, "the last window is one without load"
    each = [1.0 - rates[i] / ((rates[i - 1] + rates[i + 1]) / 2.0) for i in range(1, len(rates), 2)]
    calm = rates[::2]
    error = statistics.stdev(each) / len(each) ** 0.5 if len(each) > 1 else None
    chance = [abs(1.0 - b / a) for a, b in pairwise(calm)]
    return {
        "median": statistics.median(each),
        "least": min(each),
        "greatest": max(each),
        "mean": statistics.fmean(each),
        "standard_error": error,
        "each": each,
        "between_calm_neighbours": statistics.median(chance),
    }


def answered(windows: Sequence[Window]) -> dict[str, dict[str, float]]:
    """Milliseconds until the answer, of every route and of all, from when a request was due."""
    took: dict[str, list[float]] = {route: [] for route in ROUTES}
    for window in windows:
        for route, values in (window.answers or {}).get("took_ms", {}).items():
            took[route] += values
    took["all"] = [value for values in took.values() for value in values]
    return {route: _percentiles(values) for route, values in took.items() if values}


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    shares = {"p50_ms": 0.5, "p90_ms": 0.9, "p99_ms": 0.99, "max_ms": 1.0}
    return {"num": len(values), **{name: round(percentile(values, share), 3) for name, share in shares.items()}}


def summarise(windows: Sequence[Window], rates: Sequence[float], num_cpus: int) -> dict[str, Any]:
    """Everything measured, for JSON.

    Args:
        windows: without load and with, in turn.
        rates: env steps a second in each.
        num_cpus: of the machine.
    """
    calm, busy = windows[::2], windows[1::2]
    told = [window.answers for window in busy if window.answers is not None]
    loaded_s = sum(window.seconds for window in busy)  # from the first request to the last answer
    num = sum(len(values) for each in told for values in each["took_ms"].values())
    more = _cores(busy, SERVICE_ROLES) - _cores(calm, SERVICE_ROLES)
    return {
        "slow_down": slow_down(rates),
        "env_steps_per_s": {"without": list(rates[::2]), "with": list(rates[1::2])},
        "requests_per_s": num / loaded_s,
        "num_failed": sum(each["num_failed"] for each in told),
        "answered": answered(busy),
        "sent_late_p99_ms": percentile([value for each in told for value in each["late_ms"]], 0.99),
        "cores": {
            "client": sum(each["cpu_s"] for each in told) / loaded_s,
            "service_more": more,
            "by_role": {
                role: {"without": _cores(calm, (role,)), "with": _cores(busy, (role,))} for role in _roles(windows)
            },
        },
        "service_share_of_cores": more / num_cpus,
    }


def _cores(windows: Sequence[Window], roles: Sequence[str]) -> float:
    return statistics.fmean(sum(window.cores.get(role, 0.0) for role in roles) for window in windows)


def _roles(windows: Sequence[Window]) -> list[str]:
    return sorted({role for window in windows for role in window.cores})


def measure(training: Training, redis_pid: int, settings: Settings) -> tuple[list[Window], list[float]]:
    """Windows without and with requests, in turn, and the env steps a second in each."""
    progress = Progress(training.directory.metrics_file)
    ask(training, settings.rate, WARMUP_S)
    windows = [_window(training, redis_pid, settings, load=False)]
    for _ in range(settings.num_windows):
        windows += [_window(training, redis_pid, settings, load=load) for load in (True, False)]
        print(f"window {len(windows)} of {2 * settings.num_windows + 1}", flush=True)
    training.wait_for(lambda: progress.times[-1:] > [windows[-1].end])
    progress.close()
    return windows, [progress.rate(window.start, window.end) for window in windows]


def ask(training: Training, rate: float, seconds: float) -> dict[str, Any]:
    """Requests from a process of its own.

    Raises:
        TandemError: it failed.
    """
    command = [sys.executable, "-m", "benchmarks.open_loop", "{}:{}".format(*training.address), training.name]
    command += ["--rate", str(rate), "--seconds", str(seconds)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if result.returncode:
        last = (result.stderr.strip().splitlines() or ["no message"])[-1]
        raise TandemError(f"the client failed: {last}; try benchmarks/open_loop.py by hand")
    return dict(json.loads(result.stdout))


def _window(training: Training, redis_pid: int, settings: Settings, *, load: bool) -> Window:
    processes, start = {**training.processes(), redis_pid: "redis"}, time.time()
    before = {pid: cpu_s(pid) for pid in processes}
    answers = None
    if load:
        answers = ask(training, settings.rate, settings.window_s)
    else:
        time.sleep(settings.window_s)
    end = time.time()
    cores: defaultdict[str, float] = defaultdict(float)
    for pid, role in processes.items():
        cores[role] += max(0.0, cpu_s(pid) - before[pid]) / (end - start)
    if training.ended is not None:
        raise TandemError(f"the run ended in the middle: {training.last_words()}")
    if answers is not None:  # without the start of the client
        start, end = answers["start"], answers["end"]
    return Window(start, end, dict(cores), answers)


def prepare(source: RunDirectory, home: Path, name: str, server: RedisServer) -> int:
    """A run directory, a registry and a Redis from which a copy of a run goes on with all its history.

    Returns:
        Its iterations so far.
    """
    target = RunDirectory(home / "runs" / name)
    copy_run(source, target)
    newest = CheckpointStore(target.checkpoints, keep=1).steps()[-1]
    rows = [row for row in read_jsonl(source.metrics_file) if int(row["iteration"]) <= newest]
    target.metrics_file.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    shutil.copytree(ROOT / "service" / "primitives", home / "registry")
    writer = RedisWriter(server.address, name)
    for row in rows:
        writer.metrics(row)
    writer.close(timeout_s=30.0)
    return newest


def benchmark(source: RunDirectory, settings: Settings) -> dict[str, Any]:
    """Everything, in directories that are deleted at the end.

    Raises:
        TandemError: no run there with a checkpoint, or it does not go on.
    """
    num_cpus = os.cpu_count() or 1
    never = {"run.evaluation_interval": 0, "run.checkpoint_interval": 1_000_000_000}
    arguments = ["--num-actors", str(settings.num_actors or num_cpus), "--set", ENDLESS, *overrides(never)]
    with scratch() as home, RedisServer(home / "redis") as server:  # its CPU time counts as the service's
        num_iterations = prepare(source, home, "run", server)
        config = ["--config", str(RunDirectory(home / "runs" / "run").config_file)]
        with Training(home, [*config, *arguments], redis_url=server.address.url) as training:
            training.wait_for_iterations(num_iterations + NUM_WARMUP_ITERATIONS)
            print("it goes on", flush=True)
            windows, rates = measure(training, server.pid, settings)
    return {"num_iterations_before": num_iterations, **summarise(windows, rates, num_cpus)}


def report(result: Mapping[str, Any]) -> str:
    """A result for people."""
    slow, cores = result["slow_down"], result["cores"]
    head = f"{'':<12}{'num':>8}{'p50':>9}{'p90':>9}{'p99':>9}{'max':>9}  ms"
    lines = [
        f"{route:<12}{each['num']:>8}" + "".join(f"{each[key]:>9.2f}" for key in list(each)[1:])
        for route, each in result["answered"].items()
    ]
    return "\n".join(
        [
            head,
            *lines,
            f"{result['requests_per_s']:.0f} requests/s, {result['num_failed']} failed; sent late, p99: "
            f"{result['sent_late_p99_ms']:.2f} ms",
            f"slow-down: {slow['median']:.1%} ({slow['least']:.1%} to {slow['greatest']:.1%}); calm neighbours differ "
            f"by {slow['between_calm_neighbours']:.1%}",
            f"cores: client {cores['client']:.3f}, service {cores['service_more']:.3f} more, which is "
            f"{result['service_share_of_cores']:.1%} of all",
        ]
    )


def main() -> int:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add, shown = parser.add_argument, Settings()
    add("--run-dir", type=Path, metavar="DIR", required=True, help="go on from this run, with its configuration")
    add("--rate", type=float, default=shown.rate, help="requests a second (default: %(default)s)")
    add("--window", type=float, default=shown.window_s, metavar="S", help="seconds of each (default: %(default)s)")
    add("--windows", type=int, default=shown.num_windows, help="with requests (default: %(default)s)")
    add("--num-actors", type=int, default=shown.num_actors, help="default: one for each core")
    add("--json", type=Path, metavar="FILE", help="write everything measured")
    given = parser.parse_args()
    settings = Settings(given.rate, given.window, given.windows, given.num_actors)
    try:
        where = machine(*PACKAGES)
        print(describe(where), flush=True)
        result = benchmark(RunDirectory(given.run_dir), settings)
        if given.json:
            head = {"benchmark": "rest_load", "machine": where, "settings": asdict(settings)}
            write_json(given.json, head | result)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(report(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
