"""How fast a downstream worker learns, beside Stable-Baselines3's SAC as it comes, on the same task in the same run.

    python benchmarks/downstream_throughput.py --task wall --out docs/results/downstream_throughput.json

Both compose the same frozen primitives, and both learn while they are measured: the worker with its own settings (64
worlds, several large updates after a step of all), the other with one environment and every default of ``SAC``
(an update of 256 transitions after every step). They take turns, and the ratio of each turn counts.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
os.environ.update(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import gymnasium
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger

import service
import service.envs.gym.registration
from benchmarks.measuring import Sample, describe, describe_ratio, machine, measure, rates, ratio, table, write_json
from service.downstream.compose import ComposePrimitives
from service.downstream.learner import make_learner
from service.downstream.methods import METHODS
from service.downstream.settings import TrialConfig, make_trial
from service.downstream.worker import make_worlds
from service.envs.gym.registration import EPISODE_STEPS
from service.envs.tasks import find_task
from service.errors import TandemError
from service.primitives.loading import TrainedBob

WORKER, DEFAULT = "downstream worker", "SB3's SAC, defaults, one environment"
_DEFAULT_STEPS = 100
"""Of the other at a time."""
_DEFAULT_WARM_UP = 200
"""More than its 100 steps of uniform actions."""
Play = Callable[[], int]


def make_worker(trial: TrialConfig, trained: TrainedBob, num_threads: int) -> Play:
    """Plays an episode of every world, learning; it has begun to learn."""
    method = METHODS[trial.method]
    env = make_worlds(trial, method, trained, num_threads)
    learner, num = make_learner(trial, method, env), EPISODE_STEPS * trial.sac.num_worlds
    learner.learn(trial.sac.learning_starts + num)
    return _player(learner, num)


def default_learner(trial: TrialConfig, trained: TrainedBob) -> SAC:
    """SAC as it comes, in one environment of the trial's task."""
    env = ComposePrimitives(gymnasium.make(find_task(trial.task).id, config=trained.config.world), trained)
    learner = SAC("MultiInputPolicy", env, seed=trial.seed, device="cpu")
    learner.set_logger(Logger(folder=None, output_formats=[]))  # else every ``learn`` makes a directory in /tmp
    return learner


def make_default(trial: TrialConfig, trained: TrainedBob) -> Play:
    """Plays some steps of one environment, learning; it has begun to learn."""
    learner = default_learner(trial, trained)
    learner.learn(_DEFAULT_WARM_UP)
    return _player(learner, _DEFAULT_STEPS)


def _player(learner: SAC, num_steps: int) -> Play:
    def play() -> int:
        before = learner.num_timesteps
        learner.learn(num_steps, reset_num_timesteps=False)
        return learner.num_timesteps - before

    return play


def compare(trial: TrialConfig, trained: TrainedBob, *, num_pairs: int, seconds: float, threads: int) -> dict[str, Any]:
    """Measure both in turn."""
    torch.set_num_threads(threads)
    players = {WORKER: make_worker(trial, trained, threads), DEFAULT: make_default(trial, trained)}
    samples: dict[str, list[Sample]] = {name: [] for name in players}
    for _ in range(num_pairs):
        for name, play in players.items():
            samples[name].append(measure(play, seconds))
    return {
        "machine": machine("torch", "mujoco", "stable-baselines3"),
        "settings": {
            "cell": trial.model_dump(mode="json"),
            "num_pairs": num_pairs,
            "seconds": seconds,
            "threads": threads,
        },
        "rows": {name: rates(each) for name, each in samples.items()},
        "ratio": ratio(samples[WORKER], samples[DEFAULT]),
    }


def main() -> int:
    """Parse the command line, measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="wall")
    parser.add_argument("--method", default="ours", choices=[name for name, each in METHODS.items() if each.composes])
    parser.add_argument("--primitives", default="panda-cube@champion")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each sample, at least")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="of physics and torch, for both")
    parser.add_argument("--out", type=Path, metavar="FILE")
    given = parser.parse_args()
    try:
        trial, trained = make_trial(task=given.task, method=given.method), service.load_primitives(given.primitives)
        result = compare(trial, trained, num_pairs=given.pairs, seconds=given.seconds, threads=given.threads)
        if given.out is not None:
            write_json(given.out, result)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(describe(result["machine"]), table(result["rows"]), sep="\n\n")
    print("\n" + describe_ratio("worker / default", result["ratio"]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
