"""Scaling of a run on Ray, measured on one box.

    python -m benchmarks.scaling runs/cube --json docs/results/scaling_box.json

Env steps a second of a trained run with 1, 2, ... rollout actors, and with one that has a thread for every core, and
the CPU time of every process. From the CPU times of one and of two actors, and the updates that seeds needed until they
had a skill, ``docs/scaling.md`` says how long more cores take.
"""

from __future__ import annotations

import json
import math
import os
import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.measuring import run_benchmark
from benchmarks.report.markdown import commit, millions, percent
from benchmarks.training_process import ENDLESS, PLAIN, Measured, measure_copy, overrides, scratch
from service.base.markdown import table
from service.config.self_play import SelfPlayConfig
from service.store.run_directory import RunDirectory

CORES = (2, 3, 4, 8, 16, 64)
"""Numbers of cores of which the model tells: one for the learner, the others for an actor each."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What is measured."""

    run_dir: str
    """A run to go on from."""
    max_actors: int = os.cpu_count() or 1
    """Most actors on this box."""
    num_iterations: int = 25


def measure_run(
    source: RunDirectory, home: Path, num_iterations: int, num_actors: int, actor_threads: int = 1
) -> Measured:
    """Measure a run on Ray, without evaluations and checkpoints."""
    arguments = [*overrides(ENDLESS | PLAIN), "--num-actors", str(num_actors), "--actor-threads", str(actor_threads)]
    # with fewer cores, further actors would wait for one for ever
    cores = {"RAY_OVERRIDE_RESOURCES": json.dumps({"CPU": max(os.cpu_count() or 1, num_actors * actor_threads)})}
    return measure_copy(source, home, arguments, num_iterations, num_actors, variables=cores)


def benchmark(settings: Settings) -> dict[str, Any]:
    """Everything, in directories that are deleted at the end."""
    source = RunDirectory(Path(settings.run_dir))
    ways = {str(num): (num, 1) for num in range(1, settings.max_actors + 1)}
    config = source.read_config()
    assert isinstance(config, SelfPlayConfig)
    ways[f"1, of {settings.max_actors} threads"] = (1, settings.max_actors)
    found = {}
    with scratch() as home:
        for name, (num_actors, num_threads) in ways.items():
            measured = measure_run(source, home, settings.num_iterations, num_actors, num_threads)
            found[name] = box(measured, num_actors, -(-config.game.num_worlds // num_actors))
            print(f"{name} actors: {found[name]['env_steps_per_s']:,.0f} env steps/s", flush=True)
    return {"one_box": found}


def box(measured: Measured, num_actors: int, num_worlds: int) -> dict[str, Any]:
    """A measurement of some actors with ``num_worlds`` each, for JSON.

    The learner is idle while there is no update, an actor while it plays no round; evaluations, which actors make too,
    count as idle.
    """
    rows, wall_s = measured.rows[1:], measured.wall_s
    rollouts = [row.get("actor/num_rollouts", 1.0) for row in rows]
    played_s = sum(row.get("time/play_s", 0.0) * num for row, num in zip(rows, rollouts, strict=True))
    learned_s = sum(row.get("time/learn_s", 0.0) for row in rows)
    return {
        "env_steps_per_s": measured.sample.steps_per_s,
        "iteration_s": wall_s / len(rows),
        "num_worlds": num_worlds,
        "learner_idle_share": 1.0 - learned_s / wall_s,
        "actor_idle_share": 1.0 - played_s / (num_actors * wall_s),
        "cores": {role: seconds / wall_s for role, seconds in sorted(measured.role_cpu_s.items())},
    }


def box_block(result: Mapping[str, Any]) -> str:
    """One box, in Markdown, for ``docs/scaling.md``."""
    rows = []
    for num, each in result["one_box"].items():
        spent = {role: _step_us(each, role) for role in each["cores"]}
        rows.append(
            (num, f"{each['num_worlds']}", f"{each['env_steps_per_s']:,.0f}", f"{each['iteration_s']:.2f} s",
             percent(each["learner_idle_share"]), percent(each["actor_idle_share"]),
             f"{sum(each['cores'].values()):.2f} of {result['machine']['num_cpus']}",
             f"{sum(spent.values()):.0f} us", f"{spent['actor']:.0f} us", f"{spent['learner']:.0f} us")
        )  # fmt: skip
    head = ("actors", "worlds of each", "env steps/s", "an iteration", "learner idle", "actors idle", "cores busy",
            "CPU time of an env step", "in actors", "in the learner")  # fmt: skip
    where = result["machine"]
    words = f"{where['cpu']}, {where['num_cpus']} cores, {commit(where['git_commit'])}, {where['time'][:10]}."
    return f"{words}\n\n{table(head, rows)}"


def beside(result: Mapping[str, Any], other: Mapping[str, Any], name: str) -> str:
    """How a run compares with the ``other``, measured on the same machine at the same hour, in words."""
    here, there = result["one_box"], other["one_box"]
    shares = [f"{here[num]['env_steps_per_s'] / there[num]['env_steps_per_s']:.2f}" for num in ("1", "2")]
    costs = [f"{_step_us(here['1'], role) / _step_us(there['1'], role):.2f}" for role in ("actor", "learner")]
    return (
        f"That is {shares[0]} (one actor) and {shares[1]} (two) of the env steps/s of {name}, measured at the same "
        f"hour. With one actor an env step takes {costs[0]} times as much CPU time in the actor and {costs[1]} in the "
        "learner."
    )


def _step_us(each: Mapping[str, Any], role: str) -> float:
    """CPU time of an env step in the processes of a role."""
    return float(1e6 * each["cores"][role] / each["env_steps_per_s"])


@dataclass(frozen=True, slots=True)
class Costs:
    """CPU seconds of an update's parts."""

    learner_s: float
    round_s: float
    """Of an actor's round, whatever the number of its worlds."""
    world_s: float
    """Of each world of it."""
    num_worlds: int
    """Of all actors together."""

    @classmethod
    def of(cls, one_box: Mapping[str, Any]) -> Costs:
        """From what was measured with one actor, and with two that have half of the worlds each."""
        one, two = one_box["1"], one_box["2"]
        alone_s, both_s = (each["cores"]["actor"] * each["iteration_s"] for each in (one, two))
        round_s = max(both_s - alone_s, 0.0)  # two actors pay it twice
        num_worlds = one["num_worlds"]
        learner_s = one["cores"]["learner"] * one["iteration_s"]
        return cls(learner_s, round_s, (alone_s - round_s) / num_worlds, num_worlds)

    def update_s(self, num_actors: int) -> float:
        """Seconds between updates: of the slower of the learner and of actors that share the worlds, a core each."""
        worlds = math.ceil(self.num_worlds / num_actors)
        return max(self.learner_s, self.round_s + worlds * self.world_s)

    @property
    def num_fed(self) -> float:
        """Actors with all the worlds each whose rollouts the learner takes in while they play the next ones."""
        return (self.round_s + self.num_worlds * self.world_s) / self.learner_s

    @property
    def num_useful(self) -> int | None:
        """Least number of actors with which the learner is what takes longest; None: even one world each is slower."""
        fitting = [num for num in range(1, self.num_worlds + 1) if self.update_s(num) <= self.learner_s]
        return fitting[0] if fitting else None


def model_block(result: Mapping[str, Any], skill: Mapping[str, Any]) -> str:
    """Minutes to a skill on more cores, in Markdown, for ``docs/scaling.md``.

    Args:
        result: one box, as ``scaling_box.json`` has it.
        skill: times to a skill, as ``benchmarks.time_to_skill`` writes them.
    """
    num_updates = statistics.median(run["at"]["iteration"] if run["reached"] else math.inf for run in skill["runs"])
    return _model_of(Costs.of(result["one_box"]), num_updates, "the skill")


def recipe_block(result: Mapping[str, Any], env_steps: int) -> str:
    """Minutes to the end of a recipe on more cores, in Markdown, for ``docs/scaling.md``.

    Args:
        result: one box, with a run of the recipe.
        env_steps: of the whole recipe.
    """
    one = result["one_box"]["1"]
    num_updates = env_steps / (one["env_steps_per_s"] * one["iteration_s"])
    return _model_of(Costs.of(result["one_box"]), num_updates, f"{millions(env_steps)} env steps")


def _model_of(costs: Costs, num_updates: float, goal: str) -> str:
    """What the model says of so many updates, and a table of minutes to the ``goal``."""
    rows = []
    for cores in CORES:
        update_s = costs.update_s(cores - 1)
        minutes = num_updates * update_s / 60.0
        busy = costs.learner_s / update_s
        seeds = cores // 2 * 60.0 / (num_updates * costs.update_s(1) / 60.0)
        an_hour = f"{seeds:.0f}" if seeds >= 10.0 else f"{seeds:.1f}"
        rows.append((str(cores), f"{update_s:.2f} s", f"{minutes:.1f}", percent(busy), an_hour))
    head = ("cores", "an update every", f"minutes to {goal}", "learner busy", "or seeds an hour, two cores each")
    return (
        f"One learner of one thread keeps up with {costs.num_fed:.1f} actors of {costs.num_worlds} worlds each. "
        f"A run shares {costs.num_worlds} worlds out among its actors. A part of each round takes as long with few "
        "worlds as with many, so two actors are less than twice as fast as one. "
        f"A run gains {_until(costs)}.\n\n{table(head, rows)}"
    )


def words(result: Mapping[str, Any]) -> str:
    """The same in a sentence, for the README."""
    return (
        f"By a model of measured costs a run with one cube gains {_until(Costs.of(result['one_box']))}. "
        "Use further cores for more seeds ([scaling](docs/scaling.md))."
    )


def _until(costs: Costs) -> str:
    useful = costs.num_useful
    return "from every further core" if useful is None else f"nothing beyond {useful + 1} cores"


if __name__ == "__main__":
    raise SystemExit(run_benchmark("scaling_box", __doc__, Settings, benchmark, box_block))
