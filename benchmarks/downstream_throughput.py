"""Speed of a downstream worker that learns, beside Stable-Baselines3's SAC as it comes, on the same task.

    python -m benchmarks.downstream_throughput --old 543176b --json docs/results/downstream_throughput.json

Both compose the same frozen primitives, and both learn while they are measured: the worker with its own settings (64
worlds, several large updates after a step of all), the other with one environment and every default of ``SAC``
(an update of 256 transitions after every step). With ``--old`` the worker of an earlier commit is measured, too. They
take turns, each in a process of its own, and the ratio of each turn counts.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger

from benchmarks.compare_commits import full_name, worktree
from benchmarks.measuring import (
    ROOT,
    Sample,
    describe_ratio,
    parser_of,
    rates,
    rates_table,
    ratio,
    run_benchmark,
)
from benchmarks.training_process import environment, scratch
from service.downstream.compose import ComposePrimitives
from service.downstream.learner import make_loop
from service.downstream.methods import METHODS
from service.downstream.settings import TrialConfig, make_trial
from service.downstream.worker import make_worlds
from service.envs.gym.registration import EPISODE_STEPS
from service.envs.tasks import find_task
from service.errors import TandemError
from service.primitives.loading import TrainedBob

WORKER, DEFAULT, OLD = "downstream worker", "SB3's SAC, defaults, one environment", "downstream worker, old"
_DEFAULT_STEPS = 100
"""Env steps of the other at a time."""
_DEFAULT_WARM_UP = 200
"""More than its 100 steps of uniform actions."""
PACKAGES = ("torch", "mujoco", "stable-baselines3")
Play = Callable[[], int]


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of what is measured, and of what."""

    task: str = "wall"
    method: str = "ours"
    """One that composes."""
    primitives: str = "panda-cube@champion"
    num_pairs: int = 5
    seconds: float = 20.0
    """Least length of each sample."""
    threads: int = 1
    """Threads of physics and torch, for all."""
    old: str = ""
    """A commit whose worker is measured beside today's."""


_MEASURE = """
import json, sys
from dataclasses import asdict
import torch
import service
from benchmarks import downstream_throughput as benchmark
from benchmarks.measuring import measure
from service.downstream.settings import make_trial
what, task, method, primitives, threads, seconds = sys.argv[1:]
torch.set_num_threads(int(threads))
trial, trained = make_trial(task=task, method=method), service.load_primitives(primitives, "no registry")
if what == "worker":
    play = benchmark.make_worker(trial, trained, int(threads))
else:
    play = benchmark.make_default(trial, trained)
print(json.dumps(asdict(measure(play, float(seconds)))))
"""
"""Program that measures with the code of its own checkout; every commit since the first worker can run it."""


def make_worker(trial: TrialConfig, trained: TrainedBob, num_threads: int) -> Play:
    """A function that plays an episode of every world, learning; it has begun to learn."""
    method = METHODS[trial.method]
    worlds = make_worlds(trial, method, trained, num_threads)
    loop, num = make_loop(trial, method, trained, worlds), EPISODE_STEPS * trial.sac.num_worlds
    loop.play(trial.sac.learning_starts + num)

    def play() -> int:
        before = loop.num_env_steps
        loop.play(num)
        return loop.num_env_steps - before

    return play


def default_learner(trial: TrialConfig, trained: TrainedBob) -> SAC:
    """SAC as it comes, in one environment of the trial's task."""
    env = ComposePrimitives(gymnasium.make(find_task(trial.task).id, config=trained.config.world), trained)
    learner = SAC("MultiInputPolicy", env, seed=trial.seed, device="cpu")
    learner.set_logger(Logger(folder=None, output_formats=[]))  # else every ``learn`` makes a directory in /tmp
    return learner


def make_default(trial: TrialConfig, trained: TrainedBob) -> Play:
    """A function that plays some steps of one environment, learning; it has begun to learn."""
    learner = default_learner(trial, trained)
    learner.learn(_DEFAULT_WARM_UP)

    def play() -> int:
        before = learner.num_timesteps
        learner.learn(_DEFAULT_STEPS, reset_num_timesteps=False)
        return learner.num_timesteps - before

    return play


def measure_tree(tree: Path, what: str, settings: Settings, home: Path) -> Sample:
    """Measure the ``worker`` or the ``default`` learner in a process with the code of a checkout."""
    asked = (settings.task, settings.method, settings.primitives, settings.threads, settings.seconds)
    command = [sys.executable, "-c", _MEASURE, what, *map(str, asked)]
    done = subprocess.run(command, cwd=tree, env=environment(home, tree), capture_output=True, text=True, check=False)
    if done.returncode:
        raise TandemError(f"{what} in {tree}: {' '.join(done.stderr.split()[-30:])}")
    return Sample(**json.loads(done.stdout.splitlines()[-1]))


def benchmark(settings: Settings) -> dict[str, Any]:
    """Everything measured, for JSON."""
    with ExitStack() as stack:
        home = stack.enter_context(scratch())
        plays = {WORKER: (ROOT, "worker"), DEFAULT: (ROOT, "default")}
        if settings.old:
            plays[OLD] = stack.enter_context(worktree(full_name(settings.old))), "worker"
        samples: dict[str, list[Sample]] = {name: [] for name in plays}
        for _ in range(settings.num_pairs):
            for name, (tree, what) in plays.items():
                samples[name].append(measure_tree(tree, what, settings, home))
    trial = make_trial(task=settings.task, method=settings.method)
    return {
        "trial": trial.model_dump(mode="json"),
        "rows": {name: rates(each) for name, each in samples.items()},
        "ratios": {name: ratio(samples[WORKER], each) for name, each in samples.items() if name != WORKER},
    }


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    ratios = [describe_ratio(f"{WORKER} / {name}", each) for name, each in result["ratios"].items()]
    return "\n".join((rates_table(result["rows"]), "", *ratios))


def main() -> int:
    """Parse the command line, measure, print, write."""
    given = parser_of(__doc__, Settings()).parse_args()
    return run_benchmark("downstream_throughput", PACKAGES, given, Settings, benchmark, report)


if __name__ == "__main__":
    raise SystemExit(main())
