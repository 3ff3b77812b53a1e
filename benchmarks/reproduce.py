"""Run every learning experiment of the table that has no file in ``docs/results/v2``, several at once.

    python -m benchmarks.reproduce --list
    python -m benchmarks.reproduce --parallel 2

That is the table of downstream tasks, skill discovery and tasks of two cubes, by today's version of what learns.
Each is one or more of the commands that anybody can type, and this prints them. What was stopped goes on from its run
directory. Pictures and pages are made from the files afterwards, by ``python -m benchmarks.report``.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.measuring import ROOT
from service.base.version import LEARNING_VERSION
from service.config.task_methods import TASK_METHODS
from service.envs.tasks import PAPERS

PRIMITIVES = {0: "panda-cube@seed-30", 1: "panda-cube@seed-31", 2: "panda-cube@seed-32"}
"""Versions in ``primitives`` by the seed of the trials that take them: each has its own pre-training."""
PAPER_PRIMITIVES = {seed: f"panda-cube-paper@seed-{10 + seed}" for seed in PRIMITIVES}
"""The same, of the recipe as the paper has it."""
TWO_CUBES_PRIMITIVES = {0: "panda-two-cubes@seed-30", 1: "panda-two-cubes@seed-31"}
TWO_CUBES = tuple(f"docs/examples/two_cubes.py:{name}" for name in ("STACK", "UNSTACK", "SORT", "CLEAR"))
"""Tasks of two cubes."""
NETWORKS = ("monolithic", "mcp")
SKILL_METHODS = ("lsd", "metra", "dads", "diayn")
SKILL_ENV_STEPS = 4_000_000
LONGER_ENV_STEPS, TWO_CUBES_ENV_STEPS = 1_000_000, 500_000
MANY_UPDATES = 32
"""For 64 env steps, instead of 8."""
RESULTS, RUNS = ROOT / "docs" / "results" / f"v{LEARNING_VERSION}", ROOT / "runs" / "reproduce"
"""Recorded files, and run directories."""
Command = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Experiment:
    """Commands that make one recorded file."""

    name: str
    file: Path
    """It has been run if this is there."""
    group: str
    """What a page counts it under."""
    part: str
    """What it is in its group, besides its seed."""
    seed: int
    commands: Sequence[Command]
    """What to run, in this order."""
    needs: Path | None = None
    """It can be run if this is there."""
    hours: float = 0.3
    """Of one core beside another one that is busy, as those that are recorded took."""


def experiments(out: Path = RESULTS) -> Iterator[Experiment]:
    """Everything, the most important first; ``out`` has recorded files, and the registry in its ``primitives``."""
    tasks = PAPERS
    for seed in PRIMITIVES:
        yield from (_trial(out, task, method, seed) for method in ("ours-her", "ours") for task in tasks)
        yield _trial(out, "push", "ours-residual-her", seed)
        yield from (_trial(out, task, method, seed) for method in ("asp-only", "idle") for task in tasks)
    yield from _from_scratch(out, "-her")
    for task in ("inair", "sphere", "push"):
        yield from (_longer(out, task, f"scratch-{net}-her") for net in NETWORKS)
        yield _longer(out, task, "scratch-monolithic-her", MANY_UPDATES)
    for seed, reference in TWO_CUBES_PRIMITIVES.items():
        for method in ("ours-her", "asp-only", "scratch-monolithic-her"):
            yield from (_two_cubes(out, task, method, seed, reference) for task in TWO_CUBES)
    yield from (each for seed in PRIMITIVES for each in _skills(out, seed))
    yield from _from_scratch(out, "")
    for seed, reference in PAPER_PRIMITIVES.items():
        for method in ("ours", "asp-only"):
            for task in tasks:
                found = _table(out, "downstream_paper", task, method, seed, reference)
                yield replace(found, group=f"{found.group}, as the paper pre-trains")
    for seed in (0, 1):
        for method in ("ours-her", "ours", "scratch-monolithic-her", "scratch-monolithic"):
            yield replace(_trial(out, "hard-push", method, seed), group="HardPush", part=method)


def _from_scratch(out: Path, her: str) -> Iterator[Experiment]:
    for seed in PRIMITIVES:
        yield from (_trial(out, task, f"scratch-{net}{her}", seed) for net in NETWORKS for task in PAPERS)


def _trial(out: Path, task: str, method: str, seed: int) -> Experiment:
    return _table(out, "downstream", task, method, seed, PRIMITIVES[seed])


def _longer(out: Path, task: str, method: str, updates: int | None = None) -> Experiment:
    """A trial of many env steps; ``updates`` for 64 of them, where that is not as usual."""
    extra = ["--set", f"run.total_env_steps={LONGER_ENV_STEPS}"]
    extra += [] if updates is None else ["--set", f"sac.gradient_steps={updates}"]
    directory = "downstream_longer" if updates is None else f"downstream_longer_{updates}"
    found = _table(out, directory, task, method, 0, PRIMITIVES[0], tuple(extra))
    hours = 1.3 if updates is None else 2.6
    group = "a million env steps" + ("" if updates is None else f", {updates} updates")
    return replace(found, group=group, part=f"{task}-{method}", hours=hours)


def _two_cubes(out: Path, task: str, method: str, seed: int, reference: str) -> Experiment:
    extra = ("--set", f"run.total_env_steps={TWO_CUBES_ENV_STEPS}")
    found = _table(out, "two_cubes", task, method, seed, reference, extra)
    return replace(found, group="tasks of two cubes", part=f"{_name(task)}-{method}", hours=0.5)


def _name(task: str) -> str:
    """A task in names of files: those of a Python file are called ``FILE:NAME``."""
    return task.rpartition(":")[2].lower()


def _table(
    out: Path, directory: str, task: str, method: str, seed: int, reference: str, extra: Command = ()
) -> Experiment:
    """A trial with primitives or skills of the recorded registry."""
    name = f"{directory}/{_name(task)}-{method}-{seed}"
    file = out / f"{name}.json"
    command = _python(
        *("benchmarks.trials", task, method, str(seed), "--primitives", reference, "--out", str(file)),
        *("--registry", str(out / "primitives"), "--runs", str(RUNS / directory)),
        *("--set", "run.num_threads=1", *extra),
    )
    versions = out / "primitives" / "models" / reference.partition("@")[0]
    found = Experiment(name, file, TASK_METHODS[method].title, task, seed, (command,), versions)
    return found if TASK_METHODS[method].learns else replace(found, hours=0.02)


def _skills(out: Path, seed: int) -> Iterator[Experiment]:
    """Skill discovery, and what is learned downstream with the skills."""
    for method in SKILL_METHODS:
        yield _discover(out, method, seed)
    for method in SKILL_METHODS:
        rows = (method, f"{method}-zero-shot") if method in ("lsd", "metra") else (method,)
        for row in rows:
            yield from (
                _table(out, "downstream", task, row, seed, f"{_skills_name(method, seed)}@1") for task in PAPERS
            )


def _skills_name(method: str, seed: int) -> str:
    return f"panda-cube-{method}-{seed}"


def _discover(out: Path, method: str, seed: int) -> Experiment:
    run, file = RUNS / f"{method}-{seed}", out / "skills" / f"{method}-{seed}.json"
    train = _python(
        *("service", "train", f"panda-cube-{method}", "--run-dir", str(run), "--resume", "auto"),
        *("--registry", str(out / "primitives"), "--set", f"name={_skills_name(method, seed)}"),
        *("--set", f"seed={seed}", "--set", f"run.total_env_steps={SKILL_ENV_STEPS}", "--set", "run.num_threads=1"),
    )
    record = _python("benchmarks.record_run", str(run), "--skills", "--out", str(file))
    return Experiment(f"skills/{method}-{seed}", file, "skill discovery", method, seed, (train, record), hours=1.6)


def _python(*arguments: str) -> Command:
    return (sys.executable, "-m", *arguments)


def run_all(waiting: Sequence[Experiment], parallel: int, logs: Path) -> list[str]:
    """Run experiments, ``parallel`` at once, each with one thread and its output in a file of ``logs``.

    What needs another one's files comes after all that can be run before.

    Returns:
        Names of those that failed, or that needed what failed.
    """
    logs.mkdir(parents=True, exist_ok=True)
    left = list(waiting)
    with ThreadPoolExecutor(parallel) as pool:
        while ready := [each for each in left if each.needs is None or each.needs.exists()]:
            left = [each for each in left if each not in ready]
            list(pool.map(lambda each: _run_one(each, logs), ready))
    return [each.name for each in waiting if not each.file.exists()]


def _run_one(experiment: Experiment, logs: Path) -> None:
    started = time.monotonic()
    print(f"{experiment.name} ...", flush=True)
    with (logs / f"{experiment.name.replace('/', '-')}.log").open("ab") as log:
        code = _run(experiment.commands, log.fileno())
    print(f"{experiment.name}: exit code {code}, {(time.monotonic() - started) / 60:.1f} min", flush=True)


def _run(commands: Sequence[Command], log: int) -> int:
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MUJOCO_GL": "disable"}  # without videos
    for command in commands:
        code = subprocess.run(command, cwd=ROOT, env=environment, stdout=log, stderr=log, check=False).returncode
        if code:
            return code
    return 0


def main() -> int:
    """Parse the command line, run what is missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parallel", type=int, metavar="N", default=1, help="at once (default: %(default)s)")
    parser.add_argument("--list", action="store_true", help="print what is missing, and stop")
    given = parser.parse_args()
    everything = list(experiments())
    missing = [each for each in everything if not each.file.exists()]
    hours = sum(each.hours for each in missing)
    there = len(everything) - len(missing)
    print(f"{there} of {len(everything)} are there, {len(missing)} to run, some {hours:.0f} hours of one core")
    if given.list:
        for experiment in missing:
            print(experiment.name)
            for command in experiment.commands:
                print("   ", *command)
        return 0
    failed = run_all(missing, given.parallel, RUNS / "logs")
    for name in failed:
        print(f"failed: {name}; its output is in {RUNS / 'logs'}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
