"""Scaling of a run on Ray: measured on one box, and on paper beyond that.

    python -m benchmarks.scaling --run-dir runs/cube --json docs/results/scaling.json

- On this box: env steps a second of a trained run with 1, 2, ... rollout actors, and with one that has a thread for
  every core, and the CPU time of every process.
- On paper: ``scaling_model.py`` with what was measured. Tiny games, whose physics and networks cost nearly nothing,
  with 1 and with 8 actors tell what an update and what a rollout costs by itself in driver, learner, generator and
  GCS; the trained run tells what a world costs on top. Costs are CPU seconds, so that cores which all share do not
  count as work. A round is measured alone, with few and with many worlds in one process, and so are its goals in the
  task generator, updates of few and of many samples with as many gradient steps, and small and large messages between
  two ranks. Waiting for many actors is measured with as many calls that nobody answers.

What cannot be measured on one box is assumed, and is in the result: how fast a node's network is and how many actors
a node has.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks import learner_ranks
from benchmarks.cluster_throughput import measure_run
from benchmarks.measuring import ask_module, parser_of, run_benchmark
from benchmarks.report.scaling import box_block, limits_block, model_block
from benchmarks.scaling_model import (
    ACTORS,
    LEARNER,
    ROLLOUTS_IN,
    Cost,
    Model,
    Prediction,
    Ranks,
    limit,
    line,
    predict,
    ring,
    with_ranks,
)
from benchmarks.training_process import ENDLESS, Measured, Training, copy_run, environment, overrides, scratch
from service.config import MIN_ROWS
from service.io.run_directory import RunDirectory

PACKAGES = ("ray", "redis", "mujoco", "numpy", "torch")
PREDICTED = (1, 2, 4, 16, 256, 4096)
WAKES = (16, 256, 4096)
NUM_TINY_ACTORS = 8
FEW_WORLDS = 15
"""Worlds of a round that is nearly all overhead: those of one of 16 actors that share out 240."""
WORLDS_EACH = 120
"""Worlds of each actor where every actor brings as many."""
SHARED_WORLDS = 240
"""Worlds in all where actors share them out."""
GENERATOR, DRIVER, GCS = "task generator", "driver", "GCS"
WEIGHTS_OUT = "weights and snapshots to the nodes"
ROLES = {LEARNER: "learner", GENERATOR: "generator", DRIVER: "driver", GCS: "gcs"}
"""Processes that there are one of, and their roles in ``processes.py``."""


TINY = {
    "name": "tiny",
    "game.num_worlds": NUM_TINY_ACTORS,
    "game.num_goals": 2,
    "game.alice_steps": 2,
    "game.alice_steps_min": "null",
    "game.bob_margin_m": 0.0,
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
"""Games of milliseconds. Nothing is learned; all that handles rounds, updates, records and states is as in any run."""


@dataclass(frozen=True, slots=True)
class Assumed:
    """Numbers that one box cannot tell."""

    network_mb_per_s: float = 152.0
    """Between two nodes, one receiver: pulls of 1 MB between two Ray nodes on this box, pipelined. A cluster's
    network is faster."""
    actors_per_node: int = 16
    """Actors of a node, which share a copy of the weights and of the snapshot; and ranks of a node."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of what is measured."""

    max_actors: int = os.cpu_count() or 1
    """Most actors on this box."""
    num_iterations: int = 25
    num_tiny_iterations: int = 100


@dataclass(frozen=True, slots=True)
class Alone:
    """What was measured of one part by itself."""

    rounds: Mapping[str, Any]
    """Of ``scaling_probe.py``: CPU seconds by number of worlds."""
    goals: Mapping[str, Any]
    """Of ``scaling_probe.py``: CPU seconds by number of worlds."""
    updates: Mapping[str, Any]
    """CPU seconds of updates of one rank with as many gradient steps, by number of worlds."""
    messages: Mapping[str, Any]
    """Seconds of a small and of a gradient's message between two ranks, and the number of messages of an update; of a
    gradient's between four ranks, too, which share this box's cores."""
    wakes: Mapping[str, Any]
    """Of ``scaling_probe.py``."""
    sizes: Mapping[str, Any]
    """Of ``scaling_probe.py``."""


def costs(tiny: Sequence[Measured], real: Measured, alone: Alone, assumed: Assumed = Assumed()) -> Model:
    """The model's constants.

    Args:
        tiny: of tiny games with few and with many actors.
        real: of a trained run.
        alone: of single parts.
        assumed: the rest.
    """
    shares = [(each.num_rollouts / each.num_iterations, each) for each in tiny]

    def spent(role: str) -> tuple[float, float, float]:
        """Of an update and of each rollout in tiny games, and of an update of the trained run."""
        few, many = ((num, each.role_cpu_s.get(role, 0.0) / each.num_iterations) for num, each in shares)
        return *line(few, many), real.role_cpu_s.get(role, 0.0) / real.num_iterations

    num_rollouts = real.num_rollouts / real.num_iterations
    parts = {}
    for name, role in ROLES.items():
        update_s, rollout_s, all_s = spent(role)
        world_s, num_worlds = 0.0, num_rollouts * real.num_worlds
        if name == LEARNER:
            update_s += line(*_points(alone.updates))[0]
            world_s = max(0.0, (all_s - update_s - num_rollouts * rollout_s) / num_worlds)
        elif name == GENERATOR:  # mostly its state and its snapshot, which only a real run has in full
            world_s = line(*_points(alone.goals))[1]
            update_s = max(update_s, all_s - num_rollouts * rollout_s - num_worlds * world_s)
        parts[name] = Cost(update_s, rollout_s, world_s)
    few, *_, many = zip(alone.wakes["num_actors"], alone.wakes["wait_s"], strict=True)
    _, pair_s = line(few, many)
    parts[DRIVER] = Cost(parts[DRIVER].update_s, parts[DRIVER].rollout_s, pair_s=pair_s)
    bytes_per_s, sizes = assumed.network_mb_per_s * 1e6, alone.sizes
    parts[ROLLOUTS_IN] = Cost(world_s=sizes["rollout"] / sizes["num_worlds"] / bytes_per_s)
    out = sizes["weights"] + sizes["snapshot"]  # past opponents go out once in many iterations
    parts[WEIGHTS_OUT] = Cost(rollout_s=out / assumed.actors_per_node / bytes_per_s)
    round_s, world_s = line(*_points(alone.rounds))
    actor = Cost(rollout_s=round_s + _tiny_rollout_s(tiny), world_s=world_s)
    hop_s, gradient_s = ring(alone.messages["small_message_s"], alone.messages["message_s"])
    ranks = Ranks(alone.messages["num_messages"], hop_s, gradient_s)
    env_steps = real.num_steps / (real.num_rollouts * real.num_worlds)
    return Model(actor, parts, env_steps, ranks, assumed.actors_per_node)


def _points(measured: Mapping[str, Any]) -> tuple[tuple[float, float], tuple[float, float]]:
    """The first and the last number of worlds, with the seconds of each."""
    first, *_, last = zip(measured["num_worlds"], measured["cpu_s"], strict=True)
    return first, last


def _tiny_rollout_s(tiny: Sequence[Measured]) -> float:
    """What a rollout of nearly nothing costs its actor: mostly Ray."""
    return min(each.role_cpu_s.get("actor", 0.0) / each.num_rollouts for each in tiny)


def on_paper(model: Model, num_worlds: int, total_worlds: int, rows_per_world: float) -> dict[str, Any]:
    """Predictions and limits, for JSON.

    Args:
        model: see ``costs``.
        num_worlds: of each actor where every actor brings as many.
        total_worlds: of the experiment where its actors share them out.
        rows_per_world: of a minibatch, which grows with the worlds and so allows more ranks.
    """
    shares = {num: max(1, -(-total_worlds // num)) for num in PREDICTED}

    def row(num: int, worlds: int) -> dict[str, Any]:
        return _row(with_ranks(model, num, worlds, int(num * worlds * rows_per_world / MIN_ROWS)))

    limits = {name: limit(model, name, num_worlds) for name in model.parts}
    return {
        "constants": {ACTORS: asdict(model.actor), **{name: asdict(cost) for name, cost in model.parts.items()}},
        "ranks": asdict(model.ranks),
        "shared_worlds": total_worlds,
        "env_steps_per_world": model.env_steps,
        "one_rank": [_row(predict(model, num, num_worlds)) for num in PREDICTED],
        "worlds_each": [row(num, num_worlds) for num in PREDICTED],
        "worlds_shared": [row(num, worlds) for num, worlds in shares.items()],
        "limits": dict(sorted(limits.items(), key=lambda item: float("inf") if item[1] is None else item[1])),
    }


def _row(each: Prediction) -> dict[str, Any]:
    return {
        "num_actors": each.num_actors,
        "num_ranks": each.num_ranks,
        "num_worlds": each.num_worlds,
        "update_s": each.update_s,
        "env_steps_per_s": each.env_steps_per_s,
        "bottleneck": each.bottleneck,
        "seconds": dict(each.seconds),
        "actors_busy": each.busy(ACTORS),
        "learner_idle": 1.0 - each.busy(LEARNER),
    }


def make_tiny(home: Path) -> RunDirectory:
    """A run of tiny games, some iterations old, with a world for each of ``NUM_TINY_ACTORS``."""
    settings = overrides(TINY | ENDLESS)
    with Training(home, settings, name="tiny", runtime="local") as training:
        training.wait_until("iteration", 3)
    return training.directory


def benchmark(source: RunDirectory, settings: Settings) -> dict[str, Any]:
    """Everything, in directories that are deleted at the end."""
    with scratch() as home:
        numbers = (1, *range(2, settings.max_actors + 1))
        real = _measure(source, home, numbers, settings.num_iterations)
        threads = settings.max_actors
        one = measure_run(source, home, "ray", settings.num_iterations, 1, actor_threads=threads, plain=True)
        small = _measure(make_tiny(home), home, (1, NUM_TINY_ACTORS), settings.num_tiny_iterations)
        probe, ray, copy = "benchmarks.scaling_probe", environment(home), copy_run(source, home, "copy")
        config = source.read_config()
        num_worlds = config.game.num_worlds
        alone = Alone(
            rounds=ask_module(probe, "rounds", copy.path, FEW_WORLDS, num_worlds, environment=ray),
            goals=ask_module(probe, "goals", copy.path, FEW_WORLDS, num_worlds, environment=ray),
            updates=_updates(num_worlds),
            messages=_messages(num_worlds),
            wakes=ask_module(probe, "wakes", *WAKES, environment=ray),
            sizes=ask_module(probe, "sizes", copy.path, environment=ray),
        )
    model = costs(list(small.values()), real[1], alone)
    rows_per_world = min(config.learner.alice.minibatch_size, config.learner.bob.minibatch_size) / num_worlds
    return {
        "one_box": {str(num): _box(each) for num, each in real.items()} | {f"1, of {threads} threads": _box(one)},
        "tiny": {str(num): _box(each) for num, each in small.items()},
        "alone": asdict(alone),
        "assumed": asdict(Assumed()),
        "model": on_paper(model, WORLDS_EACH, SHARED_WORLDS, rows_per_world),
    }


def _updates(num_worlds: int) -> dict[str, Any]:
    """CPU seconds of updates of a quarter and of all worlds, with minibatches in proportion."""
    sizes = (num_worlds // 4, num_worlds)
    found = [
        learner_ranks.measure_ranks(1, learner_ranks.Settings(num, num_rollouts=1, minibatch_rows=0))["cpu_s"]
        for num in sizes
    ]
    return {"num_worlds": list(sizes), "cpu_s": found}


def _messages(num_worlds: int) -> dict[str, Any]:
    """Seconds of a message between ranks that do nothing else, on this box."""
    settings = learner_ranks.Settings(num_worlds, num_rollouts=4, minibatch_rows=0, num_updates=1)
    two, four = (learner_ranks.measure_ranks(num, settings) for num in (2, 4))
    names = "num_messages", "small_message_s", "message_s"
    return {name: two[name] for name in names} | {"message_s_of_four": four["message_s"]}


def _measure(source: RunDirectory, home: Path, numbers: Sequence[int], num_iterations: int) -> dict[int, Measured]:
    found = {}
    for num in numbers:
        found[num] = measure_run(source, home, "ray", num_iterations, num, plain=True)
        print(f"{num} actors: {found[num].sample.steps_per_s:,.0f} env steps/s", flush=True)
    return found


def _box(each: Measured) -> dict[str, Any]:
    return {
        "env_steps_per_s": each.num_steps / each.wall_s,
        "iteration_s": each.wall_s / each.num_iterations,
        "rollouts_per_iteration": each.num_rollouts / each.num_iterations,
        "num_worlds": each.num_worlds,
        "play_s": each.play_s,
        "learn_s": each.learn_s,
        "learner_idle_share": each.learner_idle_share,
        "actor_idle_share": each.actor_idle_share,
        "cores": {role: seconds / each.wall_s for role, seconds in sorted(each.role_cpu_s.items())},
        "cpu_s_per_iteration": {role: value / each.num_iterations for role, value in sorted(each.role_cpu_s.items())},
    }


def report(result: dict[str, Any]) -> str:
    """A result for people: the blocks of the page."""
    return "\n\n".join(block(result) for block in (box_block, model_block, limits_block))


def main() -> int:
    """Parse the command line, measure, print."""
    parser = parser_of(__doc__, Settings())
    parser.add_argument("--run-dir", type=Path, metavar="DIR", required=True, help="go on from this run")
    given = parser.parse_args()
    source = RunDirectory(given.run_dir)
    return run_benchmark("scaling", PACKAGES, given, Settings, lambda settings: benchmark(source, settings), report)


if __name__ == "__main__":
    raise SystemExit(main())
