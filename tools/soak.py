"""Run a day of rounds on Ray in some minutes, and see whether the memory of any process grows.

    python -m tools.soak --json docs/results/soak.json

Tiny games, whose rounds take milliseconds: 50,000 of them (a round is played in all worlds of an actor) are 25,000
updates of two actors, which a real run makes in a day at 3.5 s each. All that happens once a round or once an update
happens as often as in that day; the status service is asked as Prometheus and a page would. Seen from outside:
memory, file descriptors and threads of every process, from ``/proc``.

What counts is a process' own memory: neither files such as libraries, nor the object store, which Ray fills up to a
limit and then uses again. A process is flat if its second half says so twice: the last tenth of the run is not more
than 5 MB or 5 % above the tenth in the middle, and the slope of the second half makes less than 10 MB or 10 % in a
day. The history of a run's metrics is data, which the status service keeps in memory: its size, as its columns are
long, is told beside it and not counted.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from benchmarks.measuring import parser_of, run_benchmark
from benchmarks.processes import PROC, descendants, named, own_memory_mb
from benchmarks.report.cluster import soak_table, soak_words
from benchmarks.run_files import blocks
from benchmarks.training_process import ENDLESS, TINY, Training, overrides, scratch
from service.errors import TandemError

PACKAGES = ("ray", "fastapi", "mujoco", "numpy", "torch")
SCRAPES = ("/metrics", "/v1/runs/{run}", "/v1/runs/{run}/metrics?max_points=300", "/v1/runs/{run}/goals")
SMALL_MB, SMALL_SHARE = 5.0, 0.05
DAY_SMALL_MB, DAY_SMALL_SHARE = 10.0, 0.10
DAY_S = 86_400.0
NUM_POINTS = 100
NUM_BLOCKS = 20
"""Parts of a series of which the slope takes the means, each far longer than its noise remembers."""
_T_95 = 2.101
"""97.5 % of Student's t with NUM_BLOCKS - 2 degrees of freedom."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of what is measured."""

    num_rounds: int = 50_000
    num_actors: int = 2
    sample_s: float = 3.0
    real_iteration_s: float = 3.5
    """Of a real run, for what grows by the update to be told by the day."""


class Look(NamedTuple):
    """A process at some moment."""

    iteration: int
    own_mb: float
    """Without files, shared memory, and the run's history."""
    history_mb: float
    num_files: int
    num_threads: int


def slope(x: Sequence[float], y: Sequence[float]) -> tuple[float, float, float]:
    """Slope of y over x with the ends of its 95 % interval: least squares through the means of consecutive samples.

    Neighbouring samples of memory are nearly the same number, and counting each by itself would make the interval far
    too small; means of blocks are nearly independent.

    Raises:
        ValueError: fewer samples than two a block.
    """
    if len(x) < 2 * NUM_BLOCKS:
        raise ValueError(f"{len(x)} samples are too few for a slope, {2 * NUM_BLOCKS} are needed")
    xs, ys = ([part.mean() for part in np.array_split(np.asarray(v, float), NUM_BLOCKS)] for v in (x, y))
    (value, _), covariance = np.polyfit(xs, ys, 1, cov=True)
    error = _T_95 * float(np.sqrt(covariance[0, 0]))
    return float(value), float(value) - error, float(value) + error


def judge_memory(iteration: Sequence[float], own_mb: Sequence[float], per_day: float) -> dict[str, Any]:
    """Verdict on a process' memory: sizes in its second half, growth by the day, and whether it is flat; for JSON.

    Args:
        iteration: of the run at each sample.
        own_mb: of the process.
        per_day: iterations of a real run in a day.

    Raises:
        ValueError: too few samples.
    """
    half, tenth = len(own_mb) // 2, max(1, len(own_mb) // 10)
    grown, low, high = (per_day * each for each in slope(iteration[half:], own_mb[half:]))
    middle_mb, end_mb = statistics.fmean(own_mb[half : half + tenth]), statistics.fmean(own_mb[-tenth:])
    little = end_mb - middle_mb < max(SMALL_MB, SMALL_SHARE * middle_mb)
    return {
        "middle_mb": middle_mb,
        "end_mb": end_mb,
        "growth_mb": end_mb - middle_mb,
        "per_day_mb": grown,
        "per_day_low_mb": low,
        "per_day_high_mb": high,
        "flat": little and grown < max(DAY_SMALL_MB, DAY_SMALL_SHARE * middle_mb),
    }


def is_steady(counts: Sequence[int]) -> bool:
    """Whether a count's median in the last tenth is not above its greatest value between the middle and there.

    Connections come and go, and their number swings; what leaks goes past every earlier value.
    """
    half, tenth = len(counts) // 2, max(1, len(counts) // 10)
    return statistics.median(counts[-tenth:]) <= max(counts[half:-tenth])


class Sampler:
    """Looks at all processes of a run now and then.

    Args:
        training: the run.
    """

    def __init__(self, training: Training) -> None:
        self._training = training
        self.roles: dict[int, str] = {}
        self.looks: dict[int, list[Look]] = {}
        """By pid."""
        self.num_samples = self.num_asked = self.num_unanswered = 0

    def sample(self) -> int:
        """Ask the status service, then look at every process.

        Returns:
            Rounds that the run has learned from.
        """
        status, name = self._training.status(), self._training.name
        assert status is not None
        self.num_samples += 1
        for path in SCRAPES:
            self.num_asked += 1
            self.num_unanswered += self._training.text(path.format(run=name)) is None
        told = self._training.get(f"/v1/runs/{name}/metrics?max_points=1")
        # eight bytes for each metric of each iteration
        history_mb = 8.0 * status.iteration * (2 + len(told["metrics"])) / 1024**2 if told else 0.0
        for pid, role in descendants(self._training.pid).items():
            self._look(pid, role, status.iteration, history_mb if role == "status" else 0.0)
        return status.num_rollouts_counted

    def _look(self, pid: int, role: str, iteration: int, history_mb: float) -> None:
        own_mb = own_memory_mb(pid)
        if own_mb is None:
            return
        try:
            num_files, num_threads = (len(os.listdir(PROC / str(pid) / each)) for each in ("fd", "task"))
        except OSError:
            return
        self.roles[pid] = role
        self.looks.setdefault(pid, []).append(Look(iteration, own_mb - history_mb, history_mb, num_files, num_threads))


def summarise(looks: Mapping[int, Sequence[Look]], roles: Mapping[int, str], settings: Settings) -> dict[str, Any]:
    """A verdict on every process that lived through the second half, and thinned series of them."""
    per_day, names = DAY_S / settings.real_iteration_s, named(roles)
    longest = max(len(each) for each in looks.values())
    last = max(each[-1].iteration for each in looks.values())
    kept = {
        pid: each
        for pid, each in looks.items()
        if each[0].iteration <= last / 2 and each[-1].iteration >= 0.95 * last and len(each) >= 2 * longest // 3
    }
    found = {names[pid]: {"role": roles[pid], **_verdict(each, per_day)} for pid, each in kept.items()}
    return {
        "iterations_a_day": per_day,
        "processes": found,
        "left_out": sorted(names[pid] for pid in looks.keys() - kept.keys()),
        "all_flat": all(each["flat"] and each["descriptors_flat"] for each in found.values()),
    }


def _verdict(looks: Sequence[Look], per_day: float) -> dict[str, Any]:
    iteration, own_mb, _, num_files, num_threads = map(list, zip(*looks, strict=True))
    half, parts = len(looks) // 2, blocks(len(looks), NUM_POINTS)
    return {
        **judge_memory(iteration, own_mb, per_day),
        "start_mb": own_mb[0],
        "history_mb": looks[-1].history_mb,
        "num_files": {"middle": num_files[half], "end": num_files[-1]},
        "num_threads": {"middle": num_threads[half], "end": num_threads[-1]},
        "descriptors_flat": is_steady(num_files) and is_steady(num_threads),
        "series": {
            "iteration": [iteration[part[-1]] for part in parts],
            "own_mb": [round(statistics.fmean(own_mb[i] for i in part), 2) for part in parts],
        },
    }


def benchmark(settings: Settings) -> dict[str, Any]:
    """Play so many rounds, and look at the processes meanwhile.

    Raises:
        TandemError: the run ends before.
    """
    arguments = ["--num-actors", str(settings.num_actors), *overrides(TINY | ENDLESS)]
    with scratch() as home, Training(home, arguments) as training:
        training.wait_for_iterations(1)
        sampler, start, num_rounds = Sampler(training), time.monotonic(), 0
        while num_rounds < settings.num_rounds or sampler.num_samples < 4 * NUM_BLOCKS:
            if training.ended is not None:
                raise TandemError(f"the run ended after {num_rounds} rounds: {training.last_words()}")
            num_rounds = sampler.sample()
            if sampler.num_samples % 20 == 0:
                print(f"{time.monotonic() - start:6.0f} s: {num_rounds:,} rounds", flush=True)
            time.sleep(settings.sample_s)
        seconds, end = time.monotonic() - start, training.status()
    assert end is not None
    return {
        "num_rounds": num_rounds,
        "num_iterations": end.iteration,
        "seconds": seconds,
        "num_refused": end.num_rollouts_refused,
        "num_replaced": sum(actor.incarnation for actor in end.actors),
        "asked": {"num": sampler.num_asked, "unanswered": sampler.num_unanswered},
        **summarise(sampler.looks, sampler.roles, settings),
    }


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    return f"{soak_words(result)}\n\n{soak_table(result)}\n\nall flat: {result['all_flat']}"


def main() -> int:
    """Parse the command line, measure, print."""
    given = parser_of(__doc__, Settings()).parse_args()
    return run_benchmark("soak", PACKAGES, given, Settings, benchmark, report)


if __name__ == "__main__":
    raise SystemExit(main())
