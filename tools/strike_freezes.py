"""Random freezes of a run's processes, one alone or all together, and who was ended meanwhile; for ``strikes``."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from benchmarks.processes import descendants
from benchmarks.training_process import Training
from service.io.run_log import FILE as LOG_FILE
from tools.strike_runs import Watcher

KINDS = ("driver", "learner", "generator", "actor", "raylet", "gcs", "all")
ALONE_S, ALL_S, BETWEEN_S = (1.0, 25.0), (1.0, 30.0), (5.0, 15.0)
"""Least and most seconds of a freeze of one process, of one of all, and between two."""
STALL_S = 30.0
"""A worker that was frozen for so long may be ended."""
_GONE = re.compile(r"^(?:the |rollout actor )(?P<worker>\w+) is gone \((?P<reason>.*)\); another ")


@dataclass(frozen=True, slots=True)
class Freeze:
    """A freeze that was over."""

    at: float
    """Seconds since 1970."""
    what: str
    worker: str
    """``learner``, ``generator`` or the number of an actor; empty for others."""
    seconds: float


@contextmanager
def busy(num: int) -> Iterator[None]:
    """Keep so many processes spinning beside the block."""
    spinners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(num)]
    try:
        yield
    finally:
        for spinner in spinners:
            spinner.kill()
            spinner.wait()


def freeze_at_random(training: Training, watcher: Watcher, seconds: float, rng: random.Random) -> Iterator[Freeze]:
    """Freeze one kind of process after another, for so long; ends early with the run."""
    while training.ended is None and watcher.since() < seconds:
        watcher.until(lambda status: training.ended is not None, rng.uniform(*BETWEEN_S))
        what = rng.choice(KINDS)
        lasting_s = rng.uniform(*(ALL_S if what == "all" else ALONE_S))
        roles = descendants(training.pid)
        pids = list(roles) if what == "all" else [pid for pid, role in roles.items() if role == what]
        if not pids or training.ended is not None:
            continue
        if what != "all":
            pids = [rng.choice(sorted(pids))]
        status = training.status()
        names = {each.pid: each.name.removeprefix("rollout-") for each in status.actors} if status is not None else {}
        at, begun_s = time.time(), time.monotonic()
        try:
            for pid in pids:
                _signal(pid, signal.SIGSTOP)
            watcher.until(lambda status: False, lasting_s)
        finally:
            for pid in pids:
                _signal(pid, signal.SIGCONT)
        freeze = Freeze(at, what, names.get(pids[0], "") if what != "all" else "", time.monotonic() - begun_s)
        print(f"{watcher.since():6.0f} s: {what} {freeze.worker} was frozen for {freeze.seconds:.1f} s", flush=True)
        yield freeze


def endings(training: Training, freezes: Sequence[Freeze]) -> list[dict[str, Any]]:
    """Every ending of a worker that the run's log tells of, its reason, and whether a freeze justifies it.

    Nobody kills a worker here, and none is frozen alone for as long as one may be: so a reason is only what froze it
    for ``STALL_S`` within two minutes before.
    """
    found = []
    for line in (training.directory.path / LOG_FILE).read_text().splitlines():
        told = json.loads(line)
        if (match := _GONE.match(told["text"])) is None:
            continue
        at = datetime.fromisoformat(told["at"]).timestamp()
        own = [
            each
            for each in freezes
            if each.worker == match["worker"] and each.at < at < each.at + 120.0 and each.seconds >= STALL_S
        ]
        found.append({"at": at, "worker": match["worker"], "reason": match["reason"], "justified": bool(own)})
    return found


def _signal(pid: int, kind: signal.Signals) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, kind)
