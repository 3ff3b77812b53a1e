"""Some iterations of a pre-training run with either runner, in a process of its own.

    python -m benchmarks.runner_probe RUN_DIR local 25
    python -m benchmarks.runner_probe RUN_DIR ray 25 --num-actors 2

goes on from the newest checkpoint of a run directory, which it changes, as ``tandem pretrain`` does: with records,
checkpoints and one evaluation, and on a cluster with Redis and the status service. It prints what was measured as
one line of JSON. ``cluster_throughput.py`` and ``scaling.py`` start it.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

# before NumPy is imported: as the command line does
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

from benchmarks.processes import cpu_s, descendants
from benchmarks.trainings import ENDLESS
from service.config import load_config
from service.io.run_directory import RunDirectory
from service.runtime.local import LocalRun
from service.runtime.reporting import Report
from service.runtime.runner import Metrics, Runner
from service.store.address import address_from_environment
from service.store.fanout import open_writer

NUM_WARMUP_ITERATIONS = 4
"""After a start, before it is measured: by then the learner and all actors are busy."""
NUM_BROADCASTS = 20
NEVER = "run.checkpoint_interval=1000000000"


@dataclass(frozen=True, slots=True)
class Measured:
    """Some iterations."""

    num_steps: int
    wall_s: float
    cpu_s: float
    """Of all processes of the run, Redis and the status service included."""
    num_iterations: int
    num_rollouts: int
    num_actors: int
    num_worlds: int
    """Of each actor."""
    play_s: float
    """Mean duration of a round."""
    hand_over_s: float
    """Mean of what a round costs its actor beside playing it: weights, assignment, results, a driver that is busy."""
    learn_s: float
    """Mean duration of an update."""
    checkpoint_s: float
    """All of them together; actors and learner go on meanwhile, but are given nothing new."""
    mean_policy_lag: float
    max_policy_lag: float
    role_cpu_s: dict[str, float]
    """CPU seconds by role of process, several of one role together."""

    @property
    def learner_idle_share(self) -> float:
        """Of the wall time, without an update."""
        return 1.0 - self.num_iterations * self.learn_s / self.wall_s

    @property
    def actor_idle_share(self) -> float:
        """Of the actors' wall time, without a round; evaluations, which actors make too, count as idle."""
        return 1.0 - self.num_rollouts * self.play_s / (self.num_actors * self.wall_s)

    @property
    def slot_wait_s(self) -> float:
        """Seconds, of all actors together, in which they had handed everything over and were given nothing.

        They wait for a slot, which an update frees: it is what acting and learning do not overlap.
        """
        busy_s = self.num_rollouts * (self.play_s + self.hand_over_s)
        return max(0.0, self.num_actors * self.wall_s - busy_s)


@dataclass(frozen=True, slots=True)
class _Mark:
    num_steps: int
    at_s: float
    role_cpu_s: Mapping[str, float]
    checkpoint_s: float


class Watch:
    """Asks a run to stop after so many iterations, and knows what they took.

    Args:
        run: by a runner of either kind.
        num_iterations: to be measured, at least 1.
        num_warmup: before them, at least 1, from when all actors are up.
        num_actors: of a cluster.
    """

    def __init__(
        self, run: Runner, num_iterations: int, num_warmup: int = NUM_WARMUP_ITERATIONS, *, num_actors: int = 0
    ) -> None:
        self._run, self._num, self._warmup, self._num_actors = run, num_iterations, num_warmup, num_actors
        self._marks: list[_Mark] = []
        self._rows: list[Metrics] = []

    def on_iteration(self, metrics: Metrics) -> None:
        """For ``Runner.run``."""
        if not self._rows and metrics.get("actor/num_alive", self._num_actors) < self._num_actors:
            return
        self._rows.append(metrics)
        if len(self._rows) in (self._warmup, self._warmup + self._num):
            seconds: defaultdict[str, float] = defaultdict(float)
            for pid, role in descendants(os.getpid()).items():
                seconds[role] += cpu_s(pid)
            spent = self._run.timing.seconds["checkpoint"]
            self._marks.append(_Mark(int(metrics["env_steps"]), time.perf_counter(), seconds, spent))
        if len(self._rows) == self._warmup + self._num:
            self._run.request_stop()

    def measured(self, num_actors: int, num_worlds: int) -> Measured:
        """After the run."""
        (first, last), rows = self._marks, self._rows[self._warmup :]
        wall_s = last.at_s - first.at_s
        role_cpu_s = {role: seconds - first.role_cpu_s.get(role, 0.0) for role, seconds in last.role_cpu_s.items()}
        rollouts = [row.get("actor/num_rollouts", 1.0) for row in rows]
        return Measured(
            num_steps=last.num_steps - first.num_steps,
            wall_s=wall_s,
            cpu_s=sum(role_cpu_s.values()),
            num_iterations=len(rows),
            num_rollouts=int(sum(rollouts)),
            num_actors=num_actors,
            num_worlds=num_worlds,
            play_s=_weighted([row.get("time/play_s", 0.0) for row in rows], rollouts),
            hand_over_s=_weighted([row.get("time/hand_over_s", 0.0) for row in rows], rollouts),
            learn_s=statistics.fmean(row["time/learn_s"] for row in rows),
            checkpoint_s=last.checkpoint_s - first.checkpoint_s,
            mean_policy_lag=statistics.fmean(row["learner/policy_lag"] for row in rows),
            max_policy_lag=max(row.get("learner/max_policy_lag", row["learner/policy_lag"]) for row in rows),
            role_cpu_s=role_cpu_s,
        )


def _weighted(values: Sequence[float], weights: Sequence[float]) -> float:
    return sum(a * b for a, b in zip(values, weights, strict=True)) / sum(weights)


def probe(
    directory: RunDirectory,
    runtime: Literal["local", "ray"],
    num_iterations: int,
    num_actors: int,
    *,
    plain: bool = False,
) -> Measured:
    """Go on with a run as ``tandem pretrain --resume`` does, for so many iterations after some to warm up.

    Args:
        directory: of the run.
        runtime: which runner.
        num_iterations: one of them has an evaluation.
        plain: without evaluations and checkpoints.
        num_actors: of a cluster; this process is connected to one.
    """
    changed = (NEVER, "run.evaluation_interval=0") if plain else (f"run.evaluation_interval={num_iterations}",)
    config = load_config(directory.config_file, [ENDLESS, *changed])
    with ExitStack() as stack:
        stack.callback(directory.close)
        directory.claim(resume=True)
        redis = address_from_environment() if runtime == "ray" else None
        writer = open_writer(directory.path, directory.path.name, redis)
        report = stack.enter_context(Report(config, directory.path.name, runtime, writer))
        run: Runner
        if runtime == "ray":
            from service.runtime.cluster import ClusterRun
            from service.runtime.ray_connection import ClusterOptions, StatusOptions
            from service.runtime.status_actor import serving

            home = directory.path.absolute().parent
            stack.enter_context(serving(StatusOptions(port=0), home, home / "registry", redis))
            run = stack.enter_context(closing(ClusterRun(config, directory, ClusterOptions(num_actors), resume=True)))
        else:
            run = stack.enter_context(closing(LocalRun(config, directory, resume=True)))
        watch = Watch(run, num_iterations, num_actors=num_actors if runtime == "ray" else 0)

        def tell(metrics: Metrics) -> None:
            report.iteration(run, metrics)
            watch.on_iteration(metrics)

        report.begin(run)
        run.run(tell, lambda: report.beat(run))
        report.end("interrupted")
    return watch.measured(num_actors, -(-config.game.num_worlds // num_actors))


def broadcast(weights: Any, num_actors: int) -> dict[str, float]:
    """Median seconds to put weights into the object store, and until so many actors have them; an idle call beside it.

    The actors do nothing else, and everything is warm.
    """
    import ray

    class Receiver:
        def take(self, weights: Any) -> None:
            """Nothing: Ray gets the arguments before it calls."""

    actor = ray.remote(Receiver).options(num_cpus=0)
    receivers: list[Any] = [actor.remote() for _ in range(num_actors)]
    took: dict[str, list[float]] = {"put_s": [], "delivered_s": [], "idle_call_s": []}
    for index in range(NUM_BROADCASTS + 1):
        start = time.perf_counter()
        reference = ray.put(weights)
        put = time.perf_counter()
        ray.get([each.take.remote(reference) for each in receivers])
        delivered = time.perf_counter()
        ray.get([each.take.remote(None) for each in receivers])
        end = time.perf_counter()
        if index:  # the first one starts processes
            took["put_s"].append(put - start)
            took["delivered_s"].append(delivered - put)
            took["idle_call_s"].append(end - delivered)
    return {name: statistics.median(values) for name, values in took.items()}


def newest_weights(directory: RunDirectory) -> Any:
    """The weights of the newest checkpoint, as the learner would give them out; and they have no torch in them."""
    from service.learner.weights import Weights
    from service.primitives.loading import read_parameters

    alice, bob = (dict(read_parameters(directory, player)) for player in ("alice", "bob"))
    return Weights(0, alice, bob, bob)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("runtime", choices=("local", "ray"))
    parser.add_argument("iterations", type=int)
    parser.add_argument("--num-actors", type=int, default=1)
    parser.add_argument("--plain", action="store_true", help="without evaluations and checkpoints")
    given = parser.parse_args()
    directory, result = RunDirectory(given.run_dir), dict[str, Any]()
    with ExitStack() as stack:
        if given.runtime == "ray":
            from service.runtime.ray_connection import connected

            stack.enter_context(connected(None, max(given.num_actors, os.cpu_count() or 1)))
        found = probe(directory, given.runtime, given.iterations, given.num_actors, plain=given.plain)
        result |= asdict(found)
        if given.runtime == "ray":
            result["broadcast"] = broadcast(newest_weights(directory), given.num_actors)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
