"""How fast a run on Ray is beside a run in one process, on the same cores.

    python -m benchmarks.cluster_throughput --run-dir runs/cube --json docs/results/cluster_throughput.json

Both go on from the newest checkpoint of one run, in copies, so that both have the same policies: arms that touch the
object make physics dearer. A number of iterations of each is measured in turn, Ray, local, Ray, local, each time in a
new process and from the same checkpoint. Evaluations, checkpoints and records are part of both, Redis and the status
service of the run on Ray. The local runner uses all cores, the run on Ray has an actor for each, and its learner shares
them.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.measuring import Sample, describe, describe_ratio, machine, rates, ratio, table, write_json
from benchmarks.runner_probe import Measured
from benchmarks.trainings import ROOT, copy_run, environment, scratch
from service.errors import TandemError
from service.io.run_directory import RunDirectory

PACKAGES = ("ray", "redis", "mujoco", "numpy", "torch")
RUNTIMES = ("ray", "local")


@dataclass(frozen=True, slots=True)
class Settings:
    """How much is measured."""

    num_pairs: int = 5
    num_iterations: int = 25
    """Of each measurement; they hold one evaluation and a checkpoint, twice as often as the rest of a run does."""
    num_actors: int = 0
    """0: as many as there are cores."""


@dataclass(frozen=True, slots=True)
class Probed:
    """What one process measured."""

    measured: Measured
    broadcast: dict[str, float]

    @property
    def sample(self) -> Sample:
        """Its env steps."""
        return Sample(self.measured.num_steps, self.measured.wall_s, self.measured.cpu_s)


def probe(
    source: RunDirectory, home: Path, runtime: str, num_iterations: int, num_actors: int, *, plain: bool = False
) -> Probed:
    """Measure one runner in a process of its own, on a copy of ``source`` in ``home`` that is deleted afterwards.

    ``plain``: without evaluations and checkpoints.

    Raises:
        TandemError: the process failed.
    """
    directory = RunDirectory(home / "run")
    copy_run(source, directory)
    command = [sys.executable, "-m", "benchmarks.runner_probe", str(directory.path), runtime, str(num_iterations)]
    command += ["--num-actors", str(num_actors), *(["--plain"] if plain else [])]
    result = subprocess.run(command, cwd=ROOT, env=environment(home), capture_output=True, text=True)
    shutil.rmtree(directory.path)
    if result.returncode:
        last = (result.stderr.strip().splitlines() or ["no message"])[-1]
        raise TandemError(f"a run with --runtime {runtime} failed: {last}; try it by hand")
    told = json.loads(result.stdout.strip().splitlines()[-1])
    return Probed(broadcast=told.pop("broadcast", {}), measured=Measured(**told))


def compare(source: RunDirectory, settings: Settings) -> dict[str, list[Probed]]:
    """Measure both runners in turn, from the newest checkpoint of ``source``."""
    num_actors = settings.num_actors or os.cpu_count() or 1
    found: dict[str, list[Probed]] = {runtime: [] for runtime in RUNTIMES}
    with scratch() as home:
        for _ in range(settings.num_pairs):
            for runtime in RUNTIMES:
                num = num_actors if runtime == "ray" else 1
                found[runtime].append(probe(source, home, runtime, settings.num_iterations, num))
                print(f"{runtime}: {found[runtime][-1].sample.steps_per_s:,.0f} env steps/s", flush=True)
    return found


def summarise(found: dict[str, list[Probed]]) -> dict[str, Any]:
    """Everything measured, for JSON."""
    samples = {runtime: [each.sample for each in probed] for runtime, probed in found.items()}
    return {
        "rows": {runtime: rates(each) for runtime, each in samples.items()},
        "ratio": ratio(samples["ray"], samples["local"]),
        "ray": _details([each.measured for each in found["ray"]]),
        "local": _details([each.measured for each in found["local"]]),
        "broadcast": _broadcast(found["ray"]),
    }


def _details(measured: Sequence[Measured]) -> dict[str, Any]:
    wall_s = sum(each.wall_s for each in measured)
    has_actors = measured[0].play_s > 0.0  # the local runner plays and learns in one process
    return {
        "num_actors": measured[0].num_actors,
        "learner_idle_share": _over_time(measured, "learner_idle_share"),
        "actor_idle_share": _over_time(measured, "actor_idle_share") if has_actors else None,
        "policy_lag": {
            "mean": statistics.fmean(each.mean_policy_lag for each in measured),
            "max": max(each.max_policy_lag for each in measured),
        },
        "checkpoint_share": sum(each.checkpoint_s for each in measured) / wall_s,
        "play_s": statistics.median(each.play_s for each in measured),
        "hand_over_s": statistics.median(each.hand_over_s for each in measured),
        "learn_s": statistics.median(each.learn_s for each in measured),
        "slot_wait_share": _slot_wait_share(measured) if has_actors else None,
        "iteration_s": _iteration_s(measured),
    }


def _over_time(measured: Sequence[Measured], name: str) -> float:
    shares = (float(getattr(each, name)) * each.wall_s for each in measured)
    return sum(shares) / sum(each.wall_s for each in measured)


def _broadcast(probed: Sequence[Probed]) -> dict[str, float]:
    """How long weights take, and how much of updates and weights acting overlaps.

    Were nothing overlapped, every actor would wait for the whole update and its weights after each round it played.
    What it does wait for a slot, after handing a round over and before the next, is measured.
    """
    ray = [each.measured for each in probed]
    seconds = {name: statistics.median(each.broadcast[name] for each in probed) for name in probed[0].broadcast}
    waited_s = sum(each.slot_wait_s for each in ray)
    to_wait_s = sum(each.num_rollouts * (each.learn_s + seconds["delivered_s"]) for each in ray)
    return {
        **seconds,
        "share_of_iteration": (seconds["put_s"] + seconds["delivered_s"]) / _iteration_s(ray),
        "overlapped_share": max(0.0, 1.0 - waited_s / to_wait_s),
    }


def _slot_wait_share(measured: Sequence[Measured]) -> float:
    return sum(each.slot_wait_s for each in measured) / sum(each.num_actors * each.wall_s for each in measured)


def _iteration_s(measured: Sequence[Measured]) -> float:
    return sum(each.wall_s for each in measured) / sum(each.num_iterations for each in measured)


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    lines = [table(result["rows"]), describe_ratio("ray / local", result["ratio"])]
    lines += [f"{runtime}: {result[runtime]}" for runtime in RUNTIMES]
    return "\n".join([*lines, f"broadcast: {result['broadcast']}"])


def main() -> int:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add, shown = parser.add_argument, Settings()
    add("--run-dir", type=Path, metavar="DIR", required=True, help="go on from this run, with its configuration")
    add("--pairs", type=int, default=shown.num_pairs, help="measurements of each (default: %(default)s)")
    add("--iterations", type=int, default=shown.num_iterations, help="of each (default: %(default)s)")
    add("--num-actors", type=int, default=shown.num_actors, help="default: one for each core")
    add("--json", type=Path, metavar="FILE", help="write everything measured")
    given = parser.parse_args()
    settings = Settings(given.pairs, given.iterations, given.num_actors)
    try:
        where = machine(*PACKAGES)
        print(describe(where), flush=True)
        result = summarise(compare(RunDirectory(given.run_dir), settings))
        if given.json:
            head = {"benchmark": "cluster_throughput", "machine": where, "settings": asdict(settings)}
            write_json(given.json, head | result)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(report(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
