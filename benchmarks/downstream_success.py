"""Success of Stable-Baselines3's SAC as it comes: the other half of ``downstream_throughput.py``.

    python -m benchmarks.downstream_success --task wall --json docs/results/downstream_success.json

One environment, every default of ``SAC``, the same frozen primitives, and the goals that the trials of the table are
evaluated on. A point of the curve has the wall-clock time of learning alone, as the trials count it.
"""

from __future__ import annotations

import os
import time
from dataclasses import asdict, dataclass
from typing import Any

import torch
from stable_baselines3 import SAC

import service
from benchmarks.downstream_throughput import PACKAGES, default_learner
from benchmarks.measuring import parser_of, run_benchmark
from service.downstream.methods import METHODS, Method, provenance
from service.downstream.playing import CURVE_SEED, FINAL_SEED, evaluate_on
from service.downstream.settings import TrialConfig, make_trial
from service.envs.observations import BOB, POSITIONS
from service.primitives.loading import TrainedBob
from service.types import FloatArray


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of learning, and of what."""

    task: str = "wall"
    method: str = "ours"
    """One that composes."""
    primitives: str = "panda-cube@champion"
    seed: int = 0
    num_env_steps: int = 200_000
    every: int = 10_000
    """Env steps between two points of the curve."""
    threads: int = os.cpu_count() or 1
    """Threads of physics and torch."""


class DefaultPolicy:
    """What SB3's SAC has learned: Bob's input to actions, without noise."""

    def __init__(self, learner: SAC, method: Method, trained: TrainedBob) -> None:
        self._learner, self._method, self._trained = learner, method, trained

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        """(N, 14) Bob's input to actions (N, 4)."""
        positions = observation[:, : POSITIONS.size]
        seen = {
            "observation": positions,
            "achieved_goal": observation[:, BOB["object"]],
            "desired_goal": observation[:, BOB["goal"]],
        }
        actions, _ = self._learner.predict(seen, deterministic=True)
        return self._method.decode(self._trained, positions, positions, actions)


def learn(trial: TrialConfig, trained: TrainedBob, settings: Settings) -> dict[str, Any]:
    """Learn ``trial.num_env_steps``; evaluate after every ``settings.every`` env steps and at the end."""
    torch.set_num_threads(settings.threads)
    learner = default_learner(trial, trained)

    def player() -> DefaultPolicy:
        return DefaultPolicy(learner, METHODS[trial.method], trained)

    curve: list[dict[str, float]] = []
    wall_s, world = 0.0, trained.config.world
    while learner.num_timesteps < trial.num_env_steps:
        begun = time.perf_counter()
        num = min(settings.every, trial.num_env_steps - learner.num_timesteps)
        learner.learn(num, reset_num_timesteps=not curve, log_interval=None)  # type: ignore[arg-type]
        wall_s += time.perf_counter() - begun
        found = evaluate_on(
            trial.task, world, player(), trial.curve_episodes, trial.seed + CURVE_SEED, settings.threads
        )
        rates = {"success_last": found.success_last, "success_ever": found.success_ever}
        curve.append({"env_steps": learner.num_timesteps, "wall_s": wall_s, **rates})
        print(f"{learner.num_timesteps:10,} env steps, {wall_s:6.0f} s: {found.success_last:.0%}", flush=True)
    final = evaluate_on(trial.task, world, player(), trial.num_episodes, trial.seed + FINAL_SEED, settings.threads)
    return {
        "settings": {**asdict(settings), **provenance(trained, trial.method)},
        "curve": curve,
        "evaluation": final.as_dict(),
        "wall_s": wall_s,
    }


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    found = result["evaluation"]
    low, high = found["success_last_low"], found["success_last_high"]
    minutes = result["wall_s"] / 60
    return f"{found['success_last']:.1%} at the last step [{low:.0%}, {high:.0%}] after {minutes:.0f} min"


def benchmark(settings: Settings) -> dict[str, Any]:
    """Everything measured, for JSON."""
    chosen = {name: getattr(settings, name) for name in ("task", "method", "seed", "num_env_steps")}
    return learn(make_trial(**chosen), service.load_primitives(settings.primitives), settings)


def main() -> int:
    """Parse the command line, learn, print, write."""
    given = parser_of(__doc__, Settings()).parse_args()
    return run_benchmark("downstream_success", PACKAGES, given, Settings, benchmark, report)


if __name__ == "__main__":
    raise SystemExit(main())
