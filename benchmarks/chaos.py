"""Shoot at a pre-training run for ten minutes: who is killed, how soon each is back, and whether anything was lost.

    python -m benchmarks.chaos --json docs/results/chaos.json

First an undisturbed run of so many minutes, and another of as many env steps, which shows how much two runs differ
by chance. Then the same again, with ``kill -9`` of a random rollout actor every 30 s, of the learner twice, of the
generator and of the status actor once, and of Redis, which comes back after 30 s with what it had written. That run
has to reach the same number of env steps by itself and publish.

All is seen from outside: statuses over REST (from the run's directory while the status service is dead), and at the
end the records, the checkpoint and what Redis knows. Only processes that this program started are killed, by pid.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from benchmarks.accounts import account, handed, ledger_of
from benchmarks.measuring import describe, machine, write_json
from benchmarks.run_files import binned, thin
from benchmarks.strikes import (
    ACTOR_EVERY_S,
    REDIS_AWAY_S,
    Planned,
    Recovery,
    Seen,
    Strike,
    Target,
    answering_again,
    choose_actor,
    plan,
    recovery,
    summary,
)
from benchmarks.trainings import ENDLESS, ROOT, Training, overrides, scratch
from service.errors import TandemError
from service.io.checkpoints import CheckpointStore
from service.store.errors import StoreError
from service.store.redis_reader import RedisReader
from tests.store.redis_server import RedisServer

PACKAGES = ("ray", "redis", "torch", "mujoco", "numpy")
TICK_S = 0.1
PATIENCE = 4.0
"""The disturbed run may take so many times as long as the undisturbed one."""
CURVES = ("bob/success_rate", "alice/valid_fraction", "learner/policy_lag", "learner/max_policy_lag")
NUM_POINTS, NUM_BINS = 60, 10


@dataclass(frozen=True, slots=True)
class Settings:
    """How much is measured."""

    minutes: float = 10.0
    actor_every_s: float = ACTOR_EVERY_S
    redis_away_s: float = REDIS_AWAY_S
    num_actors: int = 2
    num_undisturbed: int = 2
    seed: int = 0


@dataclass(slots=True)
class Outage:
    """Of Redis, for a while."""

    address: Any
    directory: Path
    server: RedisServer
    killed: float = 0.0
    returned: float = 0.0
    told_again: float = 0.0
    """When the run's status was in there that is newer than its return; 0: not yet."""
    iterations: list[int] = field(default_factory=list)
    """Of the run when it went and when it came back."""
    warned: bool = False
    """Whether the run said that it was away."""

    def kill(self) -> None:
        """As when its machine loses power, but for the disk."""
        self.killed = time.time()
        self.server.kill()
        self.server.close()

    def restart(self) -> None:
        """Where it was, with what it had written."""
        url = self.address.url
        password, _, port = url.removeprefix("redis://:").removesuffix("/0").rpartition("@127.0.0.1:")
        self.server = RedisServer(self.directory, port=int(port), password=password)
        self.returned = time.time()

    def look(self, run_id: str) -> None:
        """Whether the run has told it something since it is back."""
        try:
            told = RedisReader(self.address).run(run_id)
        except StoreError:
            return
        if told.heartbeat.timestamp() > self.returned:
            self.told_again = time.time()


class Shooting:
    """Watches a run and carries out a plan, tick by tick.

    Args:
        training: the run.
        plan: whom to kill when.
        outage: its Redis.
        settings: how long Redis is away, and the seed of what is chosen at random.
    """

    def __init__(self, training: Training, plan: Sequence[Planned], outage: Outage, settings: Settings) -> None:
        self._training, self._plan, self._outage, self._settings = training, list(plan), outage, settings
        self._rng = random.Random(settings.seed)
        self._start = time.time()
        self.strikes: list[Strike] = []
        self.seen: list[Seen] = []
        self.answers: list[tuple[float, bool]] = []

    def run(self, timeout_s: float) -> int:
        """Until the run ends; its exit code.

        Raises:
            TandemError: it does not end.
        """
        while self._training.ended is None:
            if time.time() - self._start > timeout_s:
                raise TandemError(f"the run did not end within {timeout_s:.0f} s; {self._training.last_words()}")
            self._tick()
            time.sleep(TICK_S)
        if self._outage.killed and not self._outage.returned:
            self._outage.restart()
        return self._training.wait(1.0)

    def recoveries(self) -> list[Recovery]:
        """Of each strike."""
        return [self._recovery(strike) for strike in self.strikes]

    def _tick(self) -> None:
        self.answers.append((time.time(), self._training.get("/livez", timeout_s=1.0) is not None))
        status = self._training.status()
        if status is None:
            return
        self.seen.append(Seen(time.time(), status))
        outage = self._outage
        if outage.killed and not outage.returned:
            outage.warned = outage.warned or any("Redis" in warning for warning in status.warnings)
            if time.time() - outage.killed >= self._settings.redis_away_s:
                outage.iterations.append(status.iteration)
                outage.restart()
        elif outage.returned and not outage.told_again:
            outage.look(status.run_id)
        if self._plan and time.time() - self._start >= self._plan[0].at_s and self._strike(self._plan[0].target):
            self._plan.pop(0)

    def _strike(self, target: Target) -> bool:
        status = self.seen[-1].status
        if target == "redis":
            self._note(target, "redis", pid=self._outage.server.pid)
            self._outage.iterations.append(status.iteration)
            self._outage.kill()
            return True
        found = self._find(target)
        if found is None:
            return False  # it is not up just now
        name, incarnation, pid = found
        self._note(target, name, incarnation, pid)
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            self.strikes.pop()
            return False
        return True

    def _find(self, target: Target) -> tuple[str, int, int] | None:
        """Name, incarnation and pid of who is to be killed, if it is there and a process of this very run."""
        ours = self._training.processes()
        if target == "status":
            pid = next((pid for pid, name in ours.items() if name == "status"), None)
            return None if pid is None else ("status", 0, pid)
        status = self.seen[-1].status
        named = next((actor for actor in status.actors if actor.name == target), None)
        actor = choose_actor(status, self._rng) if target == "actor" else named
        if actor is None or actor.pid is None or ours.get(actor.pid) != target:
            return None
        return actor.name, actor.incarnation, actor.pid

    def _note(self, target: Target, name: str, incarnation: int = 0, pid: int = 0) -> None:
        strike = Strike(time.time(), target, name, incarnation, pid, self.seen[-1].status.num_env_steps)
        self.strikes.append(strike)
        print(f"{time.time() - self._start:6.1f} s: killed {name}", flush=True)

    def _recovery(self, strike: Strike) -> Recovery:
        if strike.target == "status":
            return answering_again(strike.at, self.answers)
        if strike.target == "redis":
            outage = self._outage
            told = outage.told_again - outage.returned if outage.told_again else None
            return Recovery(outage.returned - strike.at if outage.returned else None, told)
        return recovery(strike, self.seen)


def undisturbed(home: Path, name: str, config: Sequence[str], seconds: float | None) -> list[dict[str, Any]]:
    """The records of a run that nobody shoots at: of so many seconds from its first iteration on, or to its end."""
    with Training(home, config, name=name) as training:
        training.wait_for_iterations(1)
        if seconds is None:
            training.wait(24 * 3600.0)
        else:
            time.sleep(seconds)
            training.stop()
        return training.records()


def disturbed(home: Path, config: Sequence[str], settings: Settings) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Shoot at a run until it ends; what was found, and its records.

    Raises:
        TandemError: it did not begin, or did not end.
    """
    seconds = 60.0 * settings.minutes
    with RedisServer(home / "redis") as server:
        outage = Outage(server.address, home / "redis", server)
        try:
            with Training(home, config, redis_url=server.address.url, name="shot") as training:
                training.wait_for_iterations(1)
                schedule = plan(seconds, settings.actor_every_s)
                shooting = Shooting(training, schedule, outage, settings)
                code = shooting.run(PATIENCE * seconds + 600.0)
                return _found(training, shooting, outage, code, len(schedule)), training.records()
        finally:
            outage.server.close()


def _found(training: Training, shooting: Shooting, outage: Outage, code: int, num_planned: int) -> dict[str, Any]:
    end, rows = training.status(), training.records()
    assert end is not None
    shooting.seen.append(Seen(time.time(), end))
    newest = CheckpointStore(training.directory.checkpoints, keep=1).load_latest()
    ledger = ledger_of(newest.arrays["learner/counted"].tolist())
    recoveries = shooting.recoveries()
    told = RedisReader(outage.address).metrics(training.name)
    went_on = outage.iterations[1] - outage.iterations[0] if len(outage.iterations) == 2 else None
    began = shooting.seen[0].at
    return {
        "ended": {"exit_code": code, "state": end.state, "published": end.published, "env_steps": end.num_env_steps},
        "num_planned": num_planned,
        "strikes": [
            {**asdict(strike), "at": round(strike.at - began, 2), **asdict(back)}
            for strike, back in zip(shooting.strikes, recoveries, strict=True)
        ],
        "recovery": summary(shooting.strikes, recoveries),
        "account": account(rows, ledger, end, handed(shooting.seen)).as_dict(),
        "redis": {
            "away_s": outage.returned - outage.killed if outage.returned else None,
            "told_again_s": outage.told_again - outage.returned if outage.told_again else None,
            "iterations_meanwhile": went_on,
            "status_said_so": outage.warned,
            "history_complete": _places(told) == _places(rows),
        },
        "policy_lag": _lags(rows),
    }


def _places(rows: Sequence[Mapping[str, Any]]) -> list[list[Any]]:
    return [[row.get(key) for key in ("iteration", "env_steps", "learner/version")] for row in rows]


def _lags(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    mean = [row["learner/policy_lag"] for row in rows if "learner/policy_lag" in row]
    worst = [row["learner/max_policy_lag"] for row in rows if "learner/max_policy_lag" in row]
    return {"mean": float(np.mean(mean)), "max": max(worst)} if mean else {}


def curve(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What is kept of a run: few points of few metrics."""
    kept = [{key: row[key] for key in ("iteration", "env_steps", "time/wall_s", *CURVES) if key in row} for row in rows]
    return {"num_iterations": len(rows), "env_steps": rows[-1]["env_steps"], "wall_s": rows[-1]["time/wall_s"],
            "series": thin(kept, NUM_POINTS)}  # fmt: skip


def distance(one: Sequence[dict[str, Any]], other: Sequence[dict[str, Any]], key: str) -> float:
    """Mean over ``NUM_BINS`` equal spans of env steps of how far a metric's means in them are apart."""
    return float(np.nanmean(np.abs(binned(one, key, NUM_BINS) - binned(other, key, NUM_BINS))))


def compare(calm: Sequence[Sequence[dict[str, Any]]], shot: Sequence[dict[str, Any]], key: str) -> dict[str, Any]:
    """How far the disturbed run's curve is from undisturbed ones, and those from each other; and the last tenths."""
    pairs = [distance(a, b, key) for i, a in enumerate(calm) for b in calm[i + 1 :]]
    return {
        "disturbed_from_undisturbed": [distance(shot, each, key) for each in calm],
        "undisturbed_from_each_other": pairs,
        "last_tenth": {
            "disturbed": float(binned(shot, key, NUM_BINS)[-1]),
            "undisturbed": [float(binned(each, key, NUM_BINS)[-1]) for each in calm],
        },
    }


def benchmark(config: Sequence[str], settings: Settings) -> dict[str, Any]:
    """Everything, in directories that are deleted at the end.

    Args:
        config: arguments of ``tandem pretrain`` that say what is trained.
        settings: how much.

    Raises:
        TandemError: a run did not begin, or did not end.
    """
    actors = ["--num-actors", str(settings.num_actors)]
    with scratch() as home:
        print("an undisturbed run", flush=True)
        calm = [undisturbed(home, "calm-0", [*config, *actors, "--set", ENDLESS], 60.0 * settings.minutes)]
        budget = overrides({"run.total_env_steps": calm[0][-1]["env_steps"]})
        for index in range(1, settings.num_undisturbed):
            print("another", flush=True)
            calm.append(undisturbed(home, f"calm-{index}", [*config, *actors, *budget], None))
        print("now with kills", flush=True)
        found, shot = disturbed(home, [*config, *actors, *budget], settings)
    return {
        **found,
        "compared": {key: compare(calm, shot, key) for key in CURVES[:2]},
        "curves": {"disturbed": curve(shot), "undisturbed": [curve(each) for each in calm]},
    }


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    lines = [f"ended: {result['ended']}"]
    lines += [f"{target}: {each}" for target, each in result["recovery"].items()]
    lines += [f"account: {result['account']}", f"redis: {result['redis']}", f"policy lag: {result['policy_lag']}"]
    return "\n".join([*lines, *(f"{key}: {each}" for key, each in result["compared"].items())])


def main() -> int:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add, shown = parser.add_argument, Settings()
    add("--config", type=Path, metavar="FILE", default=ROOT / "configs" / "pretrain" / "panda_cube.yaml")
    add("--set", metavar="A.B=C", action="append", default=[], dest="overrides", help="a key of the configuration")
    add("--minutes", type=float, default=shown.minutes, help="of the undisturbed run (default: %(default)s)")
    add("--actor-every", type=float, default=shown.actor_every_s, metavar="S", help="(default: %(default)s)")
    add("--redis-away", type=float, default=shown.redis_away_s, metavar="S", help="(default: %(default)s)")
    add("--num-actors", type=int, default=shown.num_actors, help="(default: %(default)s)")
    add("--undisturbed", type=int, default=shown.num_undisturbed, metavar="N", help="runs (default: %(default)s)")
    add("--seed", type=int, default=shown.seed, help="of who is killed (default: %(default)s)")
    add("--json", type=Path, metavar="FILE", help="write everything measured")
    given = parser.parse_args()
    settings = Settings(
        given.minutes, given.actor_every, given.redis_away, given.num_actors, given.undisturbed, given.seed
    )
    config = ["--config", str(given.config), *(part for each in given.overrides for part in ("--set", each))]
    try:
        where = machine(*PACKAGES)
        print(describe(where), flush=True)
        result = benchmark(config, settings)
        if given.json:
            write_json(given.json, {"benchmark": "chaos", "machine": where, "settings": asdict(settings)} | result)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(report(result))
    return 0 if result["account"]["complete"] and result["ended"]["exit_code"] == 0 else 1


if __name__ == "__main__":
    raise SystemExit(main())
