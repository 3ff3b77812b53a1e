"""Speed of a run on Ray beside a run in one process, on the same cores.

    python -m benchmarks.cluster_throughput --run-dir runs/cube --json docs/results/cluster_throughput.json

Both go on from the newest checkpoint of one run, in copies, so that both have the same policies: arms that touch the
object make physics dearer. A number of iterations of each is measured in turn, Ray, local, Ray, local, each time in a
new process and from the same checkpoint. Evaluations, checkpoints and records are part of both, the status service of
the run on Ray. The local runner uses all cores, the run on Ray has an actor for each, and its learner shares them.
"""

from __future__ import annotations

import os
import shutil
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from benchmarks.measuring import ask_module, parser_of, rates, ratio, run_benchmark
from benchmarks.report.cluster import throughput_block
from benchmarks.training_process import (
    ENDLESS,
    PLAIN,
    Measured,
    Training,
    copy_run,
    environment,
    measure_training,
    overrides,
    scratch,
)
from service.io.run_directory import RunDirectory

PACKAGES = ("ray", "redis", "mujoco", "numpy", "torch")
Runtime = Literal["ray", "local"]


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of what is measured."""

    num_pairs: int = 5
    num_iterations: int = 25
    """Iterations of each measurement; they hold one evaluation and a checkpoint, twice as often as other runs."""
    num_actors: int = 0
    """0: as many as there are cores."""


def measure_run(
    source: RunDirectory,
    home: Path,
    runtime: Runtime,
    num_iterations: int,
    num_actors: int,
    *,
    actor_threads: int = 1,
    plain: bool = False,
) -> Measured:
    """Measure one runner in a process of its own, on a copy of ``source`` in ``home`` that is deleted afterwards.

    Args:
        source: the run to go on from.
        home: a directory with a short path.
        runtime: which runner.
        num_iterations: one of them has an evaluation.
        num_actors: of a run on Ray; 1 otherwise.
        actor_threads: of each of them.
        plain: without evaluations and checkpoints.
    """
    copy = copy_run(source, home)
    settings = ENDLESS | PLAIN | ({} if plain else {"run.evaluation_interval": num_iterations})
    arguments = overrides(settings)
    num_cores = max(os.cpu_count() or 1, num_actors * actor_threads)
    if runtime == "ray":
        arguments += ["--num-actors", str(num_actors), "--actor-threads", str(actor_threads)]
    with Training(home, arguments, runtime=runtime, num_cores=num_cores) as training:
        measured = measure_training(training, num_iterations, num_actors)
    shutil.rmtree(copy.path)
    return measured


def benchmark(source: RunDirectory, settings: Settings) -> dict[str, Any]:
    """Measure both runners in turn, from the newest checkpoint of ``source``, and the time of weights to all actors."""
    num_actors = settings.num_actors or os.cpu_count() or 1
    found: dict[Runtime, list[Measured]] = {runtime: [] for runtime in get_args(Runtime)}
    with scratch() as home:
        for _ in range(settings.num_pairs):
            for runtime, measured in found.items():
                num = num_actors if runtime == "ray" else 1
                measured.append(measure_run(source, home, runtime, settings.num_iterations, num))
                print(f"{runtime}: {measured[-1].sample.steps_per_s:,.0f} env steps/s", flush=True)
        arguments = ("broadcast", source.path.absolute(), num_actors)
        broadcast = ask_module("benchmarks.scaling_probe", *arguments, environment=environment(home))
    return summarise(found["ray"], found["local"], broadcast)


def summarise(ray: Sequence[Measured], local: Sequence[Measured], broadcast: dict[str, float]) -> dict[str, Any]:
    """Everything measured, for JSON.

    Were nothing overlapped, every actor would wait for the whole update and its weights after each round it played.
    What it does wait for a slot, after handing a round over and before the next, is measured.

    Args:
        ray: measurements of the run on Ray.
        local: as many of the local run.
        broadcast: see ``scaling_probe.broadcast``.
    """
    samples = {"ray": [each.sample for each in ray], "local": [each.sample for each in local]}
    waited_s = sum(each.slot_wait_s for each in ray)
    to_wait_s = sum(each.num_rollouts * (each.learn_s + broadcast["delivered_s"]) for each in ray)
    actor_s = sum(each.num_actors * each.wall_s for each in ray)
    shares = {"actor_idle_share": _over_time(ray, "actor_idle_share"), "slot_wait_share": waited_s / actor_s}
    return {
        "rows": {runtime: rates(each) for runtime, each in samples.items()},
        "ratio": ratio(samples["ray"], samples["local"]),
        "ray": _details(ray) | shares,
        "local": _details(local),
        "broadcast": {
            **broadcast,
            "share_of_iteration": (broadcast["put_s"] + broadcast["delivered_s"]) / _iteration_s(ray),
            "overlapped_share": max(0.0, 1.0 - waited_s / to_wait_s),
        },
    }


def _details(measured: Sequence[Measured]) -> dict[str, Any]:
    return {
        "num_actors": measured[0].num_actors,
        "learner_idle_share": _over_time(measured, "learner_idle_share"),
        "policy_lag": {
            "mean": statistics.fmean(each.mean_policy_lag for each in measured),
            "max": max(each.max_policy_lag for each in measured),
        },
        "play_s": statistics.median(each.play_s for each in measured),
        "hand_over_s": statistics.median(each.hand_over_s for each in measured),
        "learn_s": statistics.median(each.learn_s for each in measured),
        "iteration_s": _iteration_s(measured),
    }


def _over_time(measured: Sequence[Measured], name: str) -> float:
    shares = (float(getattr(each, name)) * each.wall_s for each in measured)
    return sum(shares) / sum(each.wall_s for each in measured)


def _iteration_s(measured: Sequence[Measured]) -> float:
    return sum(each.wall_s for each in measured) / sum(each.num_iterations for each in measured)


def main() -> int:
    """Parse the command line, measure, print."""
    parser = parser_of(__doc__, Settings())
    parser.add_argument("--run-dir", type=Path, metavar="DIR", required=True, help="go on from this run")
    given = parser.parse_args()
    source = RunDirectory(given.run_dir)
    return run_benchmark(
        "cluster_throughput", PACKAGES, given, Settings, lambda settings: benchmark(source, settings), throughput_block
    )


if __name__ == "__main__":
    raise SystemExit(main())
