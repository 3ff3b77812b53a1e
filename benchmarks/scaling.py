"""How far a run on Ray scales: one box, several nodes on it, and on paper beyond that.

    python -m benchmarks.scaling --run-dir runs/cube --json docs/results/scaling.json

- On this box: env steps a second of a trained run with 1, 2, ... rollout actors, and the CPU time of every process.
- Several nodes: the same on Ray's test cluster, whose nodes are processes here and send each other everything.
- On paper: ``scaling_model.py`` with what was measured. Tiny games, whose physics and networks cost nearly nothing,
  with 1 and with 8 actors tell what an update and what a rollout costs by itself in driver, learner, generator, GCS
  and Redis; the trained run tells what a world costs on top. Costs are CPU seconds, so that cores which all share do
  not count as work. Looking after many actors is measured with as many that do nothing.

What cannot be measured on one box is assumed, and is in the result: how fast a node's network is and how many actors
a node has.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.cluster_throughput import probe
from benchmarks.measuring import describe, machine, write_json
from benchmarks.runner_probe import Measured
from benchmarks.scaling_model import ACTORS, Cost, Model, Prediction, limit, line, predict
from benchmarks.soak import TINY
from benchmarks.trainings import ROOT, copy_run, environment, scratch
from service.config import load_config
from service.errors import TandemError
from service.io.run_directory import RunDirectory
from service.runtime.local import LocalRun

PACKAGES = ("ray", "redis", "mujoco", "numpy", "torch")
PREDICTED = (1, 2, 4, 16, 256, 4096)
WAKES = (16, 256, 4096)
NUM_TINY_ACTORS = 8
LEARNER, GENERATOR, DRIVER, ROLLOUTS_IN, WEIGHTS_OUT, GCS, REDIS = (
    "learner", "task generator", "driver", "rollouts to the learner's node", "weights to the nodes", "GCS", "Redis",
)  # fmt: skip
ROLES = {LEARNER: "learner", GENERATOR: "generator", DRIVER: "driver", GCS: "gcs", REDIS: "redis"}
"""Processes that there are one of, and their roles in ``processes.py``."""


@dataclass(frozen=True, slots=True)
class Assumed:
    """What one box cannot tell."""

    network_mb_per_s: float = 152.0
    """Between two nodes, one receiver: pulls of 1 MB between two Ray nodes on this box, pipelined. A cluster's
    network is faster."""
    redis_mb_per_s: float = 213.0
    """Values of 1 MB set over loopback."""
    actors_per_node: int = 16
    """They share a copy of the weights."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How much is measured."""

    num_actors: tuple[int, ...] = (1, 2)
    num_iterations: int = 25
    num_tiny_iterations: int = 400
    num_node_iterations: int = 12


def ask(home: Path, *arguments: object) -> dict[str, Any]:
    """What ``scaling_probe.py`` found, in a process of its own.

    Raises:
        TandemError: it failed.
    """
    command = [sys.executable, "-m", "benchmarks.scaling_probe", *map(str, arguments)]
    result = subprocess.run(command, cwd=ROOT, env=environment(home), capture_output=True, text=True)
    if result.returncode:
        last = (result.stderr.strip().splitlines() or ["no message"])[-1]
        raise TandemError(f"scaling_probe {arguments[0]} failed: {last}; try it by hand")
    return dict(json.loads(result.stdout.strip().splitlines()[-1]))


def costs(
    tiny: Sequence[Measured], real: Sequence[Measured], wakes: Mapping[str, Any], sizes: Mapping[str, Any],
    assumed: Assumed = Assumed(),
) -> Model:  # fmt: skip
    """The model's constants.

    Args:
        tiny: of tiny games with few and with many actors.
        real: of a trained run with one actor and with more, the same worlds in all.
        wakes: of ``scaling_probe.py``.
        sizes: of ``scaling_probe.py``.
        assumed: the rest.
    """
    shares = [(each.num_rollouts / each.num_iterations, each) for each in tiny]
    last = real[-1]
    num_worlds = last.num_rollouts / last.num_iterations * last.num_worlds
    parts = {}
    for name, role in ROLES.items():
        few, many = ((num, each.role_cpu_s.get(role, 0.0) / each.num_iterations) for num, each in shares)
        update_s, rollout_s = line(few, many)
        spent = last.role_cpu_s.get(role, 0.0) / last.num_iterations
        rest = spent - update_s - last.num_rollouts / last.num_iterations * rollout_s
        world_s = max(0.0, rest / num_worlds) if name in (LEARNER, GENERATOR) else 0.0
        parts[name] = Cost(update_s, rollout_s, world_s)
    turn = [a + b for a, b in zip(wakes["wait_s"], wakes["look_s"], strict=True)]
    _, pair_s = line((wakes["num_actors"][0], turn[0]), (wakes["num_actors"][-1], turn[-1]))
    parts[DRIVER] = Cost(parts[DRIVER].update_s, parts[DRIVER].rollout_s, pair_s=pair_s)
    status_bytes = wakes["status_bytes"][-1] / wakes["num_actors"][-1]
    told_s = status_bytes / 1e6 / assumed.redis_mb_per_s
    parts[REDIS] = Cost(parts[REDIS].update_s, parts[REDIS].rollout_s + told_s)
    bytes_per_s = assumed.network_mb_per_s * 1e6
    parts[ROLLOUTS_IN] = Cost(world_s=sizes["rollout"] / sizes["num_worlds"] / bytes_per_s)
    parts[WEIGHTS_OUT] = Cost(rollout_s=sizes["weights"] / assumed.actors_per_node / bytes_per_s)
    steps = sum(each.num_steps for each in real) / sum(each.num_rollouts * each.num_worlds for each in real)
    return Model(_actor(real), parts, steps)


def _actor(real: Sequence[Measured]) -> Cost:
    """An actor's rollout by its number of worlds; where there is one number only, all of it is the worlds'."""
    points = {each.num_worlds: each.role_cpu_s["actor"] / each.num_rollouts for each in real}
    if len(points) == 1:
        ((num_worlds, seconds),) = points.items()
        return Cost(world_s=seconds / num_worlds)
    few, many = min(points), max(points)
    rollout_s, world_s = line((few, points[few]), (many, points[many]))
    return Cost(rollout_s=rollout_s, world_s=world_s)


def on_paper(model: Model, num_worlds: int, total_worlds: int) -> dict[str, Any]:
    """Predictions and limits, for JSON.

    Args:
        model: see ``costs``.
        num_worlds: of each actor where every actor brings as many.
        total_worlds: of the experiment where its actors share them out.
    """
    same = [predict(model, num, num_worlds) for num in PREDICTED]
    shared = [predict(model, num, max(1, -(-total_worlds // num))) for num in PREDICTED]
    limits = {name: limit(model, name, num_worlds) for name in model.parts}
    return {
        "constants": {ACTORS: asdict(model.actor), **{name: asdict(cost) for name, cost in model.parts.items()}},
        "env_steps_per_world": model.env_steps,
        "worlds_each": [_row(each) for each in same],
        "worlds_shared": [_row(each) for each in shared],
        "limits": dict(sorted(limits.items(), key=lambda item: float("inf") if item[1] is None else item[1])),
    }


def _row(each: Prediction) -> dict[str, Any]:
    return {
        "num_actors": each.num_actors,
        "num_worlds": each.num_worlds,
        "update_s": each.update_s,
        "env_steps_per_s": each.env_steps_per_s,
        "bottleneck": each.bottleneck,
        "seconds": dict(each.seconds),
        "actors_busy": each.busy(ACTORS),
        "learner_idle": 1.0 - each.busy(LEARNER),
    }


def make_tiny(directory: RunDirectory) -> None:
    """A run of tiny games, some iterations old, with a world for each of ``NUM_TINY_ACTORS``."""
    config = load_config(None, [f"{key}={value}" for key, value in TINY.items()])
    game = config.game.model_copy(update={"num_worlds": NUM_TINY_ACTORS})
    run = LocalRun(config.model_copy(update={"game": game}), directory)
    run.run(lambda metrics: run.request_stop() if metrics["iteration"] >= 3 else None)
    directory.close()


def benchmark(source: RunDirectory, settings: Settings) -> dict[str, Any]:
    """Everything, in directories that are deleted at the end.

    Raises:
        TandemError: no run there with a checkpoint, or a process failed.
    """
    with scratch() as home:
        make_tiny(tiny := RunDirectory(home / "tiny"))
        real = _probes(source, home, settings.num_actors, settings.num_iterations)
        small = _probes(tiny, home, (1, NUM_TINY_ACTORS), settings.num_tiny_iterations)
        copy = RunDirectory(home / "copy")
        copy_run(source, copy)
        shutil.copy(source.metrics_file, copy.metrics_file)  # a record's size
        sizes = ask(home, "sizes", copy.path)
        print("nodes", flush=True)
        nodes = ask(home, "nodes", copy.path, settings.num_node_iterations)
        print("the driver's loop", flush=True)
        wakes = ask(home, "wakes", *WAKES)
    model = costs(list(small.values()), list(real.values()), wakes, sizes)
    most = real[max(real)]
    return {
        "one_box": {str(num): _box(each) for num, each in real.items()},
        "tiny": {str(num): _box(each) for num, each in small.items()},
        "nodes": nodes,
        "sizes": sizes,
        "wakes": wakes,
        "assumed": asdict(Assumed()),
        "model": on_paper(model, most.num_worlds, int(sizes["num_worlds"])),
    }


def _probes(source: RunDirectory, home: Path, numbers: Sequence[int], num_iterations: int) -> dict[int, Measured]:
    found = {}
    for num in numbers:
        found[num] = probe(source, home, "ray", num_iterations, num, plain=True).measured
        print(f"{num} actors: {found[num].num_steps / found[num].wall_s:,.0f} env steps/s", flush=True)
    return found


def _box(each: Measured) -> dict[str, Any]:
    rollouts = each.num_rollouts / each.num_iterations
    return {
        "env_steps_per_s": each.num_steps / each.wall_s,
        "iteration_s": each.wall_s / each.num_iterations,
        "rollouts_per_iteration": rollouts,
        "num_worlds": each.num_worlds,
        "play_s": each.play_s,
        "learn_s": each.learn_s,
        "learner_idle_share": each.learner_idle_share,
        "actor_idle_share": each.actor_idle_share,
        "cores": {role: seconds / each.wall_s for role, seconds in sorted(each.role_cpu_s.items())},
        "cpu_s_per_iteration": {role: value / each.num_iterations for role, value in sorted(each.role_cpu_s.items())},
    }


def report(result: Mapping[str, Any]) -> str:
    """A result for people."""
    lines = [f"{num} actors: {each['env_steps_per_s']:,.0f} env steps/s" for num, each in result["one_box"].items()]
    lines.append(f"nodes: {result['nodes']}")
    lines += [
        f"{row['num_actors']:>5} actors: {row['env_steps_per_s']:>9,.0f} env steps/s, an update "
        f"{row['update_s']:.2f} s: {row['bottleneck']}"
        for row in result["model"]["worlds_each"]
    ]
    return "\n".join([*lines, f"limits: {result['model']['limits']}"])


def main() -> int:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add, shown = parser.add_argument, Settings()
    cores = tuple(range(1, (os.cpu_count() or 1) + 1))
    add("--run-dir", type=Path, metavar="DIR", required=True, help="go on from this run, with its configuration")
    add("--num-actors", type=int, nargs="+", default=cores, metavar="N", help="default: 1 to as many as cores")
    add("--iterations", type=int, default=shown.num_iterations, help="of each (default: %(default)s)")
    add("--tiny-iterations", type=int, default=shown.num_tiny_iterations, help="(default: %(default)s)")
    add("--node-iterations", type=int, default=shown.num_node_iterations, help="(default: %(default)s)")
    add("--json", type=Path, metavar="FILE", help="write everything measured")
    given = parser.parse_args()
    numbers = tuple(sorted(set(given.num_actors)))
    settings = Settings(numbers, given.iterations, given.tiny_iterations, given.node_iterations)
    try:
        where = machine(*PACKAGES)
        print(describe(where), flush=True)
        result = benchmark(RunDirectory(given.run_dir), settings)
        if given.json:
            write_json(given.json, {"benchmark": "scaling", "machine": where, "settings": asdict(settings)} | result)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(report(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
