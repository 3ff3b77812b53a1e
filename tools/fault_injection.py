"""Inject faults into a pre-training run: recoveries, and whether anything was lost.

    python -m tools.fault_injection --minutes 10 --json chaos.json

For so many minutes a random rollout actor is ended by ``kill -9`` every 30 s, the learner twice, the generator and
the status actor once. Then the run is stopped as an operator stops it.

All is seen from outside: statuses over REST (from the run's directory while the status service is dead), and at the
end the records and the checkpoint. Only processes that this program started are killed, by pid. All times are seconds
since 1970: statuses carry the moments at which the driver heard of its workers.
"""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from benchmarks.measuring import RECIPE_FILE, parser_of, run_benchmark
from benchmarks.processes import descendants
from benchmarks.report.cluster import faults_table
from benchmarks.training_process import ENDLESS, Training, overrides, scratch
from service.store.models import ActorStatus, RunStatus
from tools.rollout_audit import audit_run

PACKAGES = ("ray", "torch", "mujoco", "numpy")
TICK_S = 0.1
Target = Literal["actor", "learner", "generator", "status"]
_OTHERS: tuple[tuple[Target, float], ...] = (("learner", 0.25), ("generator", 0.4), ("status", 0.5), ("learner", 0.6))
"""Other targets than actors, and at what share of the run."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of what is measured."""

    minutes: float = 10.0
    actor_every_s: float = 30.0
    num_actors: int = 2
    seed: int = 0
    """Seed of the choice of actors."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A process that was killed."""

    at: float
    target: Target
    name: str
    """In the run's status."""
    incarnation: int = 0
    pid: int = 0
    num_env_steps: int = 0
    """Env steps of the run so far."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """Seconds from a kill; None: not before the run ended, or nothing was seen of it."""

    up_s: float | None
    """Until another process has its place and answers."""
    working_s: float | None
    """Until its first rollout was handed over, or the first update it had a part in was out."""


def plan_faults(duration_s: float, actor_every_s: float) -> list[tuple[float, Target]]:
    """Seconds and targets: an actor every so often, and half-way between two actors the others.

    The last half interval has no fault, so that the last one's recovery can be seen.
    """
    end = duration_s - actor_every_s / 2
    faults: list[tuple[float, Target]] = [
        (actor_every_s * num, "actor") for num in range(1, int(end // actor_every_s) + 1)
    ]
    for target, share in _OTHERS:
        between_s = max(0.0, round(share * duration_s / actor_every_s - 0.5) + 0.5) * actor_every_s
        faults.append((min(between_s, end - actor_every_s / 2), target))
    return sorted(faults)


def recovery(fault: Fault, seen: Sequence[tuple[float, RunStatus]]) -> Recovery:
    """Seconds until the killed worker's place was taken, and until the next one's work was done.

    Args:
        fault: at a rollout actor, the learner or the generator.
        seen: (time, status) in order, more often than a worker takes to come up.
    """
    new = [
        (status, actor)
        for at, status in seen
        for actor in status.actors
        if at >= fault.at and actor.name == fault.name and actor.incarnation > fault.incarnation
    ]
    if not new:
        return Recovery(None, None)
    before, base = new[0]

    def since(is_done: Callable[[RunStatus, ActorStatus], bool]) -> float | None:
        done = next((actor for status, actor in new if is_done(status, actor)), None)
        return None if done is None else max(0.0, done.heartbeat.timestamp() - fault.at)

    up_s = since(lambda _, actor: actor.state == "alive" and bool(actor.pid))
    if fault.target == "actor":
        return Recovery(up_s, since(lambda _, actor: actor.num_rollouts > base.num_rollouts))
    return Recovery(up_s, since(lambda status, _: status.iteration > before.iteration))


def answering_again(at: float, answers: Sequence[tuple[float, bool]]) -> Recovery:
    """Seconds until a service that was killed ``at`` answered again, from (time, whether it answered) in order."""
    # an answer that was under way when it died does not count
    down = next((time for time, answered in answers if time > at and not answered), at)
    first = next((time for time, answered in answers if time > down and answered), None)
    since = None if first is None else first - at
    return Recovery(since, since)


class FaultInjection:
    """Watches a run and carries out a plan.

    Args:
        training: the run.
        plan: see ``plan_faults``.
        rng: chooses actors.
    """

    def __init__(self, training: Training, plan: Sequence[tuple[float, Target]], rng: random.Random) -> None:
        self._training, self._plan, self._rng = training, list(plan), rng
        self._start = time.time()
        self.faults: list[Fault] = []
        self.seen: list[tuple[float, RunStatus]] = []
        self._answers: list[tuple[float, bool]] = []

    def run(self, seconds: float) -> None:
        """Watch for so long, or until the run ends."""
        while self._training.ended is None and time.time() - self._start < seconds:
            self._answers.append((time.time(), bool(self._training.get("/livez", timeout_s=1.0))))
            if (status := self._training.status()) is not None:
                self.seen.append((time.time(), status))
                due = self._plan and time.time() - self._start >= self._plan[0][0]
                if due and self._inject(self._plan[0][1], status):
                    self._plan.pop(0)
            time.sleep(TICK_S)

    def recoveries(self) -> list[Recovery]:
        """Recovery from each fault."""
        return [
            answering_again(fault.at, self._answers) if fault.target == "status" else recovery(fault, self.seen)
            for fault in self.faults
        ]

    def _inject(self, target: Target, status: RunStatus) -> bool:
        """Kill a process of that kind; False if it is not up just now."""
        name, incarnation, pid = self._find(target, status)
        if pid is None:
            return False
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            return False
        self.faults.append(Fault(time.time(), target, name, incarnation, pid, status.num_env_steps))
        print(f"{time.time() - self._start:6.1f} s: killed {name}", flush=True)
        return True

    def _find(self, target: Target, status: RunStatus) -> tuple[str, int, int | None]:
        """Name, incarnation and pid of what is to be killed; no pid if it is not there, or no process of this run."""
        ours = descendants(self._training.pid)
        if target == "status":
            return "status", 0, next((pid for pid, name in ours.items() if name == "status"), None)
        kind = "rollout-" if target == "actor" else target
        up = [each for each in status.actors if each.name.startswith(kind) and each.state == "alive" and each.pid]
        if not up or ours.get((actor := self._rng.choice(up)).pid or 0) != target:
            return target, 0, None
        return actor.name, actor.incarnation, actor.pid


def benchmark(config: Path, settings: Settings) -> dict[str, Any]:
    """Inject faults into a run with that configuration, in a directory that is deleted at the end; for JSON."""
    arguments = ["--config", str(config), "--num-actors", str(settings.num_actors), *overrides(ENDLESS)]
    seconds = 60.0 * settings.minutes
    plan = plan_faults(seconds, settings.actor_every_s)
    with scratch() as home, Training(home, arguments) as training:
        training.wait_until("iteration", 1)
        injection = FaultInjection(training, plan, random.Random(settings.seed))
        injection.run(seconds)
        training.stop()
        end = training.status()
        assert end is not None
        account = audit_run(training.directory, end, [status for _, status in injection.seen])
    faults, recoveries, (began, _) = injection.faults, injection.recoveries(), injection.seen[0]
    return {
        "ended": {"exit_code": training.ended, "state": end.state, "env_steps": end.num_env_steps},
        "num_planned": len(plan),
        "strikes": [
            {**asdict(fault), "at": round(fault.at - began, 2), **asdict(back)}
            for fault, back in zip(faults, recoveries, strict=True)
        ],
        "account": account,
    }


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    return f"{faults_table(result)}\n\n{result['account']}\n{result['ended']}"


def main() -> int:
    """Parse the command line, measure, print."""
    parser = parser_of(__doc__, Settings())
    parser.add_argument("--config", type=Path, metavar="FILE", default=RECIPE_FILE)
    given = parser.parse_args()
    return run_benchmark("faults", PACKAGES, given, Settings, lambda each: benchmark(given.config, each), report)


if __name__ == "__main__":
    raise SystemExit(main())
