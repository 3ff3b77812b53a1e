"""How well Stable-Baselines3's SAC learns a task as it comes: the other half of ``downstream_throughput.py``.

    python benchmarks/downstream_success.py --task wall --steps 200000 --out docs/results/downstream_success.json

One environment, every default of ``SAC``, the same frozen primitives, and the goals that the trials of the table are
evaluated on. A point of the curve has the wall-clock time of learning alone, as the trials count it.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
os.environ.update(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import torch

import service
from benchmarks.downstream_throughput import default_learner
from benchmarks.measuring import machine, write_json
from service.downstream.learner import LearnedPolicy
from service.downstream.methods import METHODS
from service.downstream.settings import TrialConfig, make_trial
from service.downstream.worker import CURVE_SEED, FINAL_SEED, find_provenance, play
from service.errors import TandemError
from service.primitives.loading import TrainedBob


def learn(trial: TrialConfig, trained: TrainedBob, *, every: int, threads: int) -> dict[str, Any]:
    """Learn ``trial.num_env_steps``; evaluate after every ``every`` env steps and at the end."""
    torch.set_num_threads(threads)
    learner = default_learner(trial, trained)

    def player() -> LearnedPolicy:
        return LearnedPolicy(learner, METHODS[trial.method], trained)

    curve: list[dict[str, float]] = []
    wall_s = 0.0
    while learner.num_timesteps < trial.num_env_steps:
        begun = time.perf_counter()
        num = min(every, trial.num_env_steps - learner.num_timesteps)
        learner.learn(num, reset_num_timesteps=not curve, log_interval=None)  # type: ignore[arg-type]
        wall_s += time.perf_counter() - begun
        found = play(trial, trained, player(), trial.curve_episodes, trial.seed + CURVE_SEED, threads)
        rates = {"success_last": found.success_last, "success_ever": found.success_ever}
        curve.append({"env_steps": learner.num_timesteps, "wall_s": wall_s, **rates})
        print(f"{learner.num_timesteps:10,} env steps, {wall_s:6.0f} s: {found.success_last:.0%}", flush=True)
    final = play(trial, trained, player(), trial.num_episodes, trial.seed + FINAL_SEED, threads)
    settings = trial.model_dump(mode="json", include={"task", "method", "seed", "num_env_steps"})
    return {
        "machine": machine("torch", "mujoco", "stable-baselines3"),
        "settings": {"cell": settings, **find_provenance(trained).of(trial.method), "threads": threads},
        "curve": curve,
        "evaluation": final.as_dict(),
        "wall_s": wall_s,
    }


def main() -> int:
    """Parse the command line, learn, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="wall")
    parser.add_argument("--method", default="ours", choices=[name for name, each in METHODS.items() if each.composes])
    parser.add_argument("--primitives", default="panda-cube@champion")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=200_000, help="env steps of learning")
    parser.add_argument("--every", type=int, default=10_000, help="env steps between two points of the curve")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="of physics and torch")
    parser.add_argument("--out", type=Path, metavar="FILE")
    given = parser.parse_args()
    try:
        trial = make_trial(task=given.task, method=given.method, seed=given.seed, num_env_steps=given.steps)
        result = learn(trial, service.load_primitives(given.primitives), every=given.every, threads=given.threads)
        if given.out is not None:
            write_json(given.out, result)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    found = result["evaluation"]
    low, high = found["success_last_low"], found["success_last_high"]
    print(f"{found['success_last']:.1%} at the last step [{low:.0%}, {high:.0%}] after {result['wall_s'] / 60:.0f} min")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
