"""Speed of a downstream worker that learns, beside Stable-Baselines3's SAC as it comes, on the same task.

    python -m benchmarks.downstream_throughput --task wall --json docs/results/downstream_throughput.json

Both compose the same frozen primitives, and both learn while they are measured: the worker with its own settings (64
worlds, several large updates after a step of all), the other with one environment and every default of ``SAC``
(an update of 256 transitions after every step). They take turns, and the ratio of each turn counts.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger

import service
import service.envs.gym.registration
from benchmarks.measuring import describe_ratio, measure_in_turn, parser_of, rates, rates_table, ratio, run_benchmark
from service.downstream.compose import ComposePrimitives
from service.downstream.learner import make_learner
from service.downstream.methods import METHODS
from service.downstream.settings import TrialConfig, make_trial
from service.downstream.worker import make_worlds
from service.envs.gym.registration import EPISODE_STEPS
from service.envs.tasks import find_task
from service.primitives.loading import TrainedBob

WORKER, DEFAULT = "downstream worker", "SB3's SAC, defaults, one environment"
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
    threads: int = os.cpu_count() or 1
    """Threads of physics and torch, for both."""


def make_worker(trial: TrialConfig, trained: TrainedBob, num_threads: int) -> Play:
    """A function that plays an episode of every world, learning; it has begun to learn."""
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
    """A function that plays some steps of one environment, learning; it has begun to learn."""
    learner = default_learner(trial, trained)
    learner.learn(_DEFAULT_WARM_UP)
    return _player(learner, _DEFAULT_STEPS)


def _player(learner: SAC, num_steps: int) -> Play:
    def play() -> int:
        before = learner.num_timesteps
        learner.learn(num_steps, reset_num_timesteps=False)
        return learner.num_timesteps - before

    return play


def compare(trial: TrialConfig, trained: TrainedBob, settings: Settings) -> dict[str, Any]:
    """Measure both in turn."""
    torch.set_num_threads(settings.threads)
    players = {WORKER: make_worker(trial, trained, settings.threads), DEFAULT: make_default(trial, trained)}
    samples = measure_in_turn(players, settings.num_pairs, settings.seconds)
    return {
        "settings": {**asdict(settings), "trial": trial.model_dump(mode="json")},
        "rows": {name: rates(each) for name, each in samples.items()},
        "ratio": ratio(samples[WORKER], samples[DEFAULT]),
    }


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    return f"{rates_table(result['rows'])}\n\n{describe_ratio('worker / default', result['ratio'])}"


def benchmark(settings: Settings) -> dict[str, Any]:
    """Everything measured, for JSON."""
    trial = make_trial(task=settings.task, method=settings.method)
    return compare(trial, service.load_primitives(settings.primitives), settings)


def main() -> int:
    """Parse the command line, measure, print, write."""
    given = parser_of(__doc__, Settings()).parse_args()
    return run_benchmark("downstream_throughput", PACKAGES, given, Settings, benchmark, report)


if __name__ == "__main__":
    raise SystemExit(main())
