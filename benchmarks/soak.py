"""A day of a run on Ray in some minutes: does the memory of any of its processes grow?

    python -m benchmarks.soak --json docs/results/soak.json

Tiny games, whose rounds take milliseconds: 50,000 of them (a round is played in all worlds of an actor) are 25,000
updates of two actors, which a real run makes in a day at 3.5 s each. All that happens once a round or once an update
happens as often as in that day; the status service is asked as Prometheus and a page would. Seen from outside:
memory, file descriptors and threads of every process, from ``/proc``.

What counts is a process' own memory: neither files such as libraries, nor the object store, which Ray fills up to a
limit and then uses again. A process is flat if its second half says so twice: the last tenth of the run is not more
than 5 MB or 5 % above the tenth in the middle, and the slope of the second half makes less than 10 MB or 10 % in a
day. The history of a run's metrics is data, which Redis (its newest 20,000 records) and the status service keep in
memory: its size, as Redis says it and as its columns are long, is told beside it and not counted.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from redis import Redis, RedisError

from benchmarks.estimates import NUM_BLOCKS, slope
from benchmarks.measuring import describe, machine, write_json
from benchmarks.processes import PROC, memory, named
from benchmarks.run_files import blocks
from benchmarks.trainings import ENDLESS, Training, overrides, scratch
from service.errors import TandemError
from service.store import keys
from tests.store.redis_server import RedisServer

PACKAGES = ("ray", "redis", "fastapi", "mujoco", "numpy", "torch")
TINY = {
    "name": "tiny",
    "game.num_worlds": 2,
    "game.num_goals": 2,
    "game.alice_steps": 2,
    "game.bob_steps": 2,
    "game.success_distance_m": 0.0005,
    "world.physics_step_s": 0.01,
    "world.num_substeps": 1,
    "generator.replay_buffer_size": 256,
    "policy.alice.hidden_sizes": "[8]",
    "policy.value.hidden_sizes": "[8]",
    "policy.bob.trunk_hidden_sizes": "[8]",
    "policy.bob.primitive_hidden_size": 8,
    "policy.bob.gate_hidden_sizes": "[8]",
    "learner.alice.num_epochs": 1,
    "learner.bob.num_epochs": 1,
    "run.checkpoint_interval": 200,
    "run.evaluation_interval": 0,
}
"""Nothing is learned; everything that handles rounds, updates, records and states is as in any run."""
SCRAPES = ("/metrics", "/v1/runs/{run}", "/v1/runs/{run}/metrics?max_points=300", "/v1/runs/{run}/goals")
SMALL_MB, SMALL_SHARE = 5.0, 0.05
DAY_SMALL_MB, DAY_SMALL_SHARE = 10.0, 0.10
DAY_S = 86_400.0
NUM_POINTS = 100
_MB = 1024 * 1024


@dataclass(frozen=True, slots=True)
class Settings:
    """How much is measured."""

    num_rounds: int = 50_000
    num_actors: int = 2
    sample_s: float = 3.0
    real_iteration_s: float = 3.5
    """Of a real run, for what grows by the update to be told by the day."""


@dataclass(slots=True)
class Series:
    """One process over time; index by index the same moments."""

    role: str
    pid: int
    iteration: list[int] = field(default_factory=list)
    own_mb: list[float] = field(default_factory=list)
    """Without files, shared memory, and the run's history."""
    history_mb: list[float] = field(default_factory=list)
    shared_mb: list[float] = field(default_factory=list)
    num_files: list[int] = field(default_factory=list)
    num_threads: list[int] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a series is flat, and why; everything of its second half."""

    middle_mb: float
    end_mb: float
    per_day_mb: float
    """What the slope makes in a day of a real run."""
    per_day_low_mb: float
    """Of its 95 % interval."""
    per_day_high_mb: float

    @property
    def growth_mb(self) -> float:
        """From the middle to the end."""
        return self.end_mb - self.middle_mb

    @property
    def flat(self) -> bool:
        """See the module."""
        little = self.growth_mb < max(SMALL_MB, SMALL_SHARE * self.middle_mb)
        return little and self.per_day_mb < max(DAY_SMALL_MB, DAY_SMALL_SHARE * self.middle_mb)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "growth_mb": self.growth_mb, "flat": self.flat}


def judge(iteration: Sequence[float], own_mb: Sequence[float], per_day: float) -> Verdict:
    """Whether memory is flat.

    Args:
        iteration: of the run at each sample.
        own_mb: of a process.
        per_day: iterations of a real run in a day.

    Raises:
        ValueError: too few samples.
    """
    half, tenth = len(own_mb) // 2, max(1, len(own_mb) // 10)
    grown = slope(iteration[half:], own_mb[half:])
    return Verdict(
        middle_mb=statistics.fmean(own_mb[half : half + tenth]),
        end_mb=statistics.fmean(own_mb[-tenth:]),
        per_day_mb=grown.value * per_day,
        per_day_low_mb=grown.low * per_day,
        per_day_high_mb=grown.high * per_day,
    )


class Sampler:
    """Looks at all processes of a run now and then.

    Args:
        training: the run.
        server: its Redis.
    """

    def __init__(self, training: Training, server: RedisServer) -> None:
        self._training, self._server = training, server
        self._redis: Any = Redis.from_url(server.address.url)
        self.series: dict[int, Series] = {}
        self.num_samples = self.num_asked = self.num_unanswered = 0

    def sample(self) -> int:
        """Ask the status service, then look at every process.

        Returns:
            Rounds that the run has learned from.
        """
        status = self._training.status()
        assert status is not None
        self.num_samples += 1
        self._ask()
        history = {"redis": self._redis_history_mb(), "status": self._columns_mb(status.iteration)}
        for pid, role in {**self._training.processes(), self._server.pid: "redis"}.items():
            self._look(pid, role, status.iteration, history.get(role, 0.0))
        return status.num_rollouts_counted

    def names(self) -> dict[int, str]:
        """Of all processes ever seen."""
        return named({pid: each.role for pid, each in self.series.items()})

    def _look(self, pid: int, role: str, iteration: int, history_mb: float) -> None:
        found = memory(pid)
        if found is None:
            return
        try:
            num_files = len(os.listdir(PROC / str(pid) / "fd"))
            num_threads = len(os.listdir(PROC / str(pid) / "task"))
        except OSError:
            return
        each = self.series.setdefault(pid, Series(role, pid))
        each.iteration.append(iteration)
        each.own_mb.append(found.own - history_mb)
        each.history_mb.append(history_mb)
        each.shared_mb.append(found.shared_pss)
        each.num_files.append(num_files)
        each.num_threads.append(num_threads)

    def _ask(self) -> None:
        for path in SCRAPES:
            self.num_asked += 1
            self.num_unanswered += self._training.text(path.format(run=self._training.name)) is None

    def _redis_history_mb(self) -> float:
        with suppress(RedisError):
            return float(self._redis.memory_usage(keys.metrics(self._training.name), samples=50) or 0.0) / _MB
        return 0.0

    def _columns_mb(self, iteration: int) -> float:
        """Eight bytes for each metric of each iteration."""
        told = self._training.get(f"/v1/runs/{self._training.name}/metrics?max_points=1")
        return 8.0 * iteration * (2 + len(told["metrics"])) / _MB if told else 0.0


def run(settings: Settings, changed: Mapping[str, object] = TINY) -> dict[str, Any]:
    """Play so many rounds, and look at the processes meanwhile.

    Raises:
        TandemError: the run ends before.
    """
    arguments = ["--num-actors", str(settings.num_actors), "--set", ENDLESS, *overrides(changed)]
    with scratch() as home, RedisServer(home / "redis") as server:
        with Training(home, arguments, redis_url=server.address.url) as training:
            training.wait_for_iterations(1)
            sampler, start, num_rounds = Sampler(training, server), time.monotonic(), 0
            told = start
            while num_rounds < settings.num_rounds or sampler.num_samples < 4 * NUM_BLOCKS:
                if training.ended is not None:
                    raise TandemError(f"the run ended after {num_rounds} rounds: {training.last_words()}")
                num_rounds = sampler.sample()
                if time.monotonic() - told >= 60.0:
                    told = time.monotonic()
                    print(f"{told - start:6.0f} s: {num_rounds:,} rounds", flush=True)
                time.sleep(settings.sample_s)
            seconds, end = time.monotonic() - start, training.status()
            training.stop()
        assert end is not None
        return {
            "num_rounds": num_rounds,
            "num_iterations": end.iteration,
            "seconds": seconds,
            "num_refused": end.num_rollouts_refused,
            "num_replaced": sum(actor.incarnation for actor in end.actors),
            "asked": {"num": sampler.num_asked, "unanswered": sampler.num_unanswered},
            **summarise(sampler.series, sampler.names(), settings),
        }


def summarise(series: Mapping[int, Series], names: Mapping[int, str], settings: Settings) -> dict[str, Any]:
    """A verdict on every process that lived through the second half, and thinned series of them."""
    longest = max(len(each.own_mb) for each in series.values())
    per_day = DAY_S / settings.real_iteration_s
    last = max(each.iteration[-1] for each in series.values())
    kept = {
        pid: each
        for pid, each in series.items()
        if each.iteration[0] <= last / 2 and each.iteration[-1] >= 0.95 * last and len(each.own_mb) >= 2 * longest // 3
    }
    found = {names[pid]: _one(each, per_day) for pid, each in kept.items()}
    return {
        "iterations_a_day": per_day,
        "processes": found,
        "left_out": sorted(names[pid] for pid in series.keys() - kept.keys()),
        "all_flat": all(each["flat"] and each["descriptors_flat"] for each in found.values()),
    }


def _one(each: Series, per_day: float) -> dict[str, Any]:
    half = len(each.own_mb) // 2
    parts = blocks(len(each.own_mb), NUM_POINTS)

    def points(values: Sequence[float]) -> list[float]:
        return [round(statistics.fmean(values[i] for i in part), 2) for part in parts]

    return {
        "role": each.role,
        **judge(each.iteration, each.own_mb, per_day).as_dict(),
        "start_mb": each.own_mb[0],
        "history_mb": each.history_mb[-1],
        "shared_mb": {"middle": each.shared_mb[half], "end": each.shared_mb[-1]},
        "num_files": {"middle": each.num_files[half], "end": each.num_files[-1]},
        "num_threads": {"middle": each.num_threads[half], "end": each.num_threads[-1]},
        "descriptors_flat": _steady(each.num_files) and _steady(each.num_threads),
        "series": {
            "iteration": [each.iteration[part[-1]] for part in parts],
            "own_mb": points(each.own_mb),
            "num_files": points(each.num_files),
        },
    }


def _steady(counts: Sequence[int]) -> bool:
    """Whether a count's median in the last tenth is not above its greatest value between the middle and there.

    Connections come and go, and their number swings; what leaks goes past every earlier value.
    """
    half, tenth = len(counts) // 2, max(1, len(counts) // 10)
    return statistics.median(counts[-tenth:]) <= max(counts[half:-tenth])


def report(result: Mapping[str, Any]) -> str:
    """A result for people."""
    lines = [f"{'':<20}{'middle':>9}{'end':>9}{'a day':>9}  MB     flat"]
    lines += [
        f"{name:<20}{each['middle_mb']:>9.1f}{each['end_mb']:>9.1f}{each['per_day_mb']:>+9.2f}  "
        f"[{each['per_day_low_mb']:+.1f}, {each['per_day_high_mb']:+.1f}]  {each['flat']}  files {each['num_files']}"
        for name, each in result["processes"].items()
    ]
    words = f"{result['num_rounds']:,} rounds, {result['num_iterations']:,} updates in {result['seconds']:.0f} s"
    return "\n".join([*lines, f"{words}; all flat: {result['all_flat']}; left out: {result['left_out']}"])


def main() -> int:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add, shown = parser.add_argument, Settings()
    add("--rounds", type=int, default=shown.num_rounds, help="(default: %(default)s)")
    add("--num-actors", type=int, default=shown.num_actors, help="(default: %(default)s)")
    add("--sample", type=float, default=shown.sample_s, metavar="S", help="seconds between (default: %(default)s)")
    add("--iteration-s", type=float, default=shown.real_iteration_s, help="of a real run (default: %(default)s)")
    add("--json", type=Path, metavar="FILE", help="write everything measured")
    given = parser.parse_args()
    settings = Settings(given.rounds, given.num_actors, given.sample, given.iteration_s)
    try:
        where = machine(*PACKAGES)
        print(describe(where), flush=True)
        result = run(settings)
        if given.json:
            head = {"benchmark": "soak", "machine": where, "settings": asdict(settings)}
            write_json(given.json, head | result)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(report(result))
    return 0 if result["all_flat"] else 1


if __name__ == "__main__":
    raise SystemExit(main())
