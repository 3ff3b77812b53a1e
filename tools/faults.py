"""Freeze and kill each part of a run in turn: does it go on, is nothing else ended, and is every rollout counted once?

    python -m tools.faults --json faults.json
    python -m tools.faults --only learner-frozen,redis-killed
    python -m tools.faults --only random --minutes 10

Each fault strikes a real ``tandem pretrain`` on Ray of its own, seen from outside: pids, REST, files. Only processes
that this program started are struck. All of them take about a quarter of an hour on two cores that nobody else wants.
"""

from __future__ import annotations

import functools
import os
import random
import signal
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from benchmarks.measuring import RECIPE_FILE, run_benchmark
from benchmarks.processes import descendants
from benchmarks.training_process import ENDLESS, Training, overrides, scratch
from service.base.errors import TandemError
from service.base.jsonl import read_jsonl
from service.base.markdown import table
from service.store.models import RunStatus
from tests.store.redis_server import RedisServer
from tools.rollout_audit import audit_run

SMALL = {"game.num_worlds": 48, "run.checkpoint_interval": 10, "run.evaluation_interval": 0, "run.num_threads": 1}
"""A small game, so that rounds are short beside what is measured."""
ARGUMENTS = ("--config", str(RECIPE_FILE), "--num-actors", "2", *overrides(ENDLESS | SMALL))
NUM_CALM_ITERATIONS = 4
TICK_S, PATIENCE_S = 0.2, 240.0
WITHIN_S = {signal.SIGKILL: 30.0, signal.SIGSTOP: 60.0}
"""Until a worker that was struck has a successor, and learning goes on."""
DRIVER_FROZEN_S, RESUMED_S = 67.0, 60.0
BETWEEN_S, FROZEN_S = (5.0, 15.0), (1.0, 25.0)
"""Of random faults: seconds between two, and of a freeze; a worker that is frozen for longer may be replaced."""
WORKERS = ("actor", "learner", "generator")
HOW = {"killed": signal.SIGKILL, "frozen": signal.SIGSTOP}
Workers = dict[str, tuple[int | None, int]]
"""Pid and incarnation by name."""
Fault = Callable[["Watcher"], tuple[str, bool]]
"""Strikes; what was seen, and whether that is what must be."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What is done to runs."""

    only: str = ""
    """Names of faults, with commas; all by default."""
    minutes: float = 3.0
    """Length of the faults at random."""
    seed: int = 0
    """Of the faults at random."""


class Watcher:
    """A run, and every status it told of since it was struck."""

    def __init__(self, training: Training, server: RedisServer) -> None:
        self.training, self.redis = training, server
        self.seen: list[RunStatus] = []
        self.struck_s = time.monotonic()

    def strike(self, pid: int, kind: signal.Signals) -> None:
        """Send a signal; from now on times count."""
        self.struck_s = time.monotonic()
        with suppress(ProcessLookupError):
            os.kill(pid, kind)

    def look(self) -> RunStatus:
        """The status now."""
        if (status := self.training.status()) is None:
            raise TandemError("the run has no status")
        if not self.seen or self.seen[-1].heartbeat != status.heartbeat:
            self.seen.append(status)
        return status

    def until(self, holds: Callable[[RunStatus], bool], seconds: float = PATIENCE_S) -> float | None:
        """Seconds since the strike until the status is so; None if it is not within ``seconds``."""
        deadline_s = time.monotonic() + seconds
        while time.monotonic() < deadline_s:
            if holds(self.look()):
                return time.monotonic() - self.struck_s
            time.sleep(TICK_S)
        return None

    def until_iterations(self, num: int) -> float | None:
        """Seconds since the strike until so many more iterations are over."""
        iteration = self.look().iteration
        return self.until(lambda status: status.iteration >= iteration + num)

    def workers(self) -> Workers:
        """Every worker, once each has a process."""
        self.until(lambda status: all(each.pid for each in status.actors))
        return {each.name: (each.pid, each.incarnation) for each in self.look().actors}


# --- faults -----------------------------------------------------------------------------------------------------------


def worker(watcher: Watcher, part: str, kind: signal.Signals) -> tuple[str, bool]:
    """Strike a worker: another takes its place, and no other worker is ended."""
    before = watcher.workers()
    name = "rollout-0" if part == "actor" else part
    pid, incarnation = before[name]
    assert pid is not None
    watcher.strike(pid, kind)

    def is_replaced(status: RunStatus) -> bool:
        return any(each.name == name and each.incarnation > incarnation and each.pid for each in status.actors)

    seconds = watcher.until_iterations(2) if watcher.until(is_replaced) is not None else None
    ended = changed(before, watcher.workers(), but=name)
    said = f"learning goes on after {seconds_text(seconds)}; others ended: {', '.join(ended) or 'none'}"
    return said, seconds is not None and seconds <= WITHIN_S[kind] and not ended


def driver_frozen(watcher: Watcher) -> tuple[str, bool]:
    """Freeze the driver for a minute: the status says stuck, and no worker is ended."""
    before, pid = watcher.workers(), watcher.training.pid
    watcher.strike(pid, signal.SIGSTOP)
    try:
        stuck = watcher.until(lambda status: status.condition == "stuck", DRIVER_FROZEN_S)
    finally:
        os.kill(pid, signal.SIGCONT)
    well = watcher.until(lambda status: status.condition == "well")
    ended = changed(before, watcher.workers())
    said = f"the status says stuck after {seconds_text(stuck)}; ended: {', '.join(ended) or 'none'}"
    return said, None not in (stuck, well, watcher.until_iterations(2)) and not ended


def driver_killed(watcher: Watcher) -> tuple[str, bool]:
    """Kill the driver, and type the command that resumes it: it is back where it was."""
    training = watcher.training
    training.wait_until("iteration", 16)  # so there is a checkpoint
    iteration = read_jsonl(training.directory.metrics_file)[-1]["iteration"]
    watcher.strike(training.pid, signal.SIGKILL)
    with Training(training.directory.path.parents[1], ARGUMENTS) as again:
        again.wait_for(lambda: (status := again.status()) and status.epoch >= 2 and status.iteration >= iteration)
        seconds = time.monotonic() - watcher.struck_s
    rows = [int(row["iteration"]) for row in read_jsonl(training.directory.metrics_file)]
    said = f"back at iteration {iteration:.0f} after {seconds:.1f} s"
    return said, rows == list(range(1, len(rows) + 1)) and seconds <= RESUMED_S


def redis(watcher: Watcher, kind: signal.Signals) -> tuple[str, bool]:
    """Take Redis away and bring it back: the status says so, learning goes on, and no worker is ended."""
    before, gone = watcher.workers(), watcher.redis
    watcher.strike(gone.pid, kind)
    try:
        noticed = watcher.until(lambda status: status.condition == "redis", 60.0)
        learning = watcher.until_iterations(3)
    finally:
        if kind == signal.SIGSTOP:
            os.kill(gone.pid, signal.SIGCONT)
        else:
            gone.revive()
    well = watcher.until(lambda status: status.condition == "well", 60.0)
    ended = changed(before, watcher.workers())
    said = f"the status says redis after {seconds_text(noticed)}; it {'learns on' if learning else 'stands still'}"
    return said, None not in (noticed, learning, well) and not ended


def at_random(watcher: Watcher, settings: Settings) -> tuple[str, bool]:
    """Kill and freeze workers at random, one after the other: the run goes on."""
    rng, deadline_s, num = random.Random(settings.seed), time.monotonic() + 60.0 * settings.minutes, 0
    while time.monotonic() < deadline_s and watcher.training.ended is None:
        watcher.until(lambda status: watcher.training.ended is not None, rng.uniform(*BETWEEN_S))
        part, kind = rng.choice(WORKERS), rng.choice(list(HOW.values()))
        pids = sorted(pid for pid, role in descendants(watcher.training.pid).items() if role == part)
        if not pids:  # it is being replaced
            continue
        watcher.strike(pid := rng.choice(pids), kind)
        num += 1
        if kind == signal.SIGSTOP:
            watcher.until(lambda status: False, rng.uniform(*FROZEN_S))
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
    went_on = watcher.training.ended is None and watcher.until_iterations(3) is not None
    return f"{num} faults in {settings.minutes:g} min; it {'goes on' if went_on else 'does not go on'}", went_on


def faults(settings: Settings) -> dict[str, Fault]:
    """Every fault by its name."""
    found: dict[str, Fault] = {
        f"{part}-{word}": functools.partial(worker, part=part, kind=kind)
        for part in WORKERS
        for word, kind in HOW.items()
    }
    found |= {"driver-frozen": driver_frozen, "driver-killed": driver_killed}
    found |= {f"redis-{word}": functools.partial(redis, kind=kind) for word, kind in HOW.items()}
    return found | {"random": functools.partial(at_random, settings=settings)}


def changed(before: Workers, after: Workers, but: str = "") -> list[str]:
    """Workers that are not those from before, without the one that was struck."""
    return [name for name in before if name != but and after.get(name) != before[name]]


def seconds_text(seconds: float | None) -> str:
    """Seconds for people."""
    return "never" if seconds is None else f"{seconds:.1f} s"


# --- the program ------------------------------------------------------------------------------------------------------


def play(fault: Fault, *, late: bool) -> dict[str, Any]:
    """Strike a run of its own once it learns, stop it, and audit it; for JSON.

    Args:
        fault: to strike with.
        late: whether it freezes workers, whose rollouts may then come too late.
    """
    with scratch() as home, RedisServer(home / "redis") as server:
        with Training(home, ARGUMENTS, variables={"TANDEM_REDIS_URL": server.address.url}) as training:
            watcher = Watcher(training, server)
            training.wait_until("iteration", NUM_CALM_ITERATIONS)
            said, reached = fault(watcher)
            account = None
            if training.ended is None:  # the audit is of a run with one driver from its beginning to its end
                watcher.look()
                training.stop()
                account = audit_run(training.directory, watcher.look(), watcher.seen, late=late)
        tracebacks = training.log_file.read_text(errors="replace").count("Traceback (most recent call last)")
    whole = account is None or account["complete"]
    return {"seen": said, "reached": reached and whole and not tracebacks, "tracebacks": tracebacks, "account": account}


def benchmark(settings: Settings) -> dict[str, Any]:
    """Every fault that was chosen; one that cannot be judged is missed."""
    known = faults(settings)
    names = settings.only.split(",") if settings.only else list(known)
    if unknown := [name for name in names if name not in known]:
        raise TandemError(f"--only: no fault {unknown[0]!r}; choose of {', '.join(known)}")
    found = {}
    for name in names:
        try:
            found[name] = play(known[name], late=not name.endswith("killed"))
        except TandemError as error:
            found[name] = {"seen": str(error), "reached": False, "tracebacks": 0, "account": None}
        print(f"{name}: {found[name]['seen']} ({found[name]['reached']})", flush=True)
    return {"faults": found}


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    rows = [
        (name, each["seen"], _account(each["account"]), "reached" if each["reached"] else "**missed**")
        for name, each in result["faults"].items()
    ]
    return table(("fault", "what was seen", "rollouts", ""), rows)


def _account(account: Mapping[str, Any] | None) -> str:
    if account is None:
        return ""
    whole = "complete" if account["complete"] else "**not complete**"
    return f"{account['num_counted']} counted, {account['num_refused']} came too late, {whole}"


def missed(result: dict[str, Any]) -> bool:
    """Whether a fault was not got over as it must be."""
    return not all(each["reached"] for each in result["faults"].values())


if __name__ == "__main__":
    raise SystemExit(run_benchmark("faults", __doc__, Settings, benchmark, report, missed))
