"""How well Stable-Baselines3's SAC learns a task as it comes: the other half of ``downstream_throughput.py``.

    python benchmarks/downstream_success.py --task wall --steps 200000 --out docs/results/downstream_success.json

One environment, every default of ``SAC``, the same frozen primitives, and the goals that the cells of the table are
evaluated on. A point of the curve has the wall-clock time of learning alone, as the cells count it.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

sys.path.insert(0, str(Path(__file__).parents[1]))
os.environ.update(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import numpy as np
import torch

import service
from benchmarks.downstream_throughput import default_learner
from benchmarks.measuring import machine, write_json
from service.actors.evaluation import Evaluation, evaluate
from service.downstream.methods import METHODS
from service.downstream.settings import CellConfig, make_cell
from service.downstream.worker import CURVE_SEED, FINAL_SEED, describe
from service.envs.observations import GOAL_SLICE, OBJECT_SLICE, POSITIONS_SIZE
from service.envs.registration import EPISODE_STEPS
from service.envs.tasks import SUCCESS_DISTANCE_M, find_task
from service.errors import TandemError
from service.runtime.primitives import TrainedBob

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from stable_baselines3 import SAC


class DefaultPolicy:
    """What the learner has learned, as ``evaluate`` takes it."""

    def __init__(self, learner: SAC, cell: CellConfig, trained: TrainedBob) -> None:
        self._learner, self._method, self._trained = learner, METHODS[cell.method], trained

    def act_deterministic(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """(N, 14) Bob's input to actions (N, 4)."""
        positions = observation[:, :POSITIONS_SIZE]
        seen = {
            "observation": positions,
            "achieved_goal": observation[:, OBJECT_SLICE],
            "desired_goal": observation[:, GOAL_SLICE],
        }
        actions, _ = self._learner.predict(cast("dict[str, Any]", seen), deterministic=True)
        return self._method.decode(self._trained, positions, actions)


def learn(cell: CellConfig, trained: TrainedBob, *, every: int, threads: int) -> dict[str, Any]:
    """Learn ``cell.num_env_steps``; evaluate after every ``every`` env steps and at the end."""
    torch.set_num_threads(threads)
    learner, task = default_learner(cell, trained), find_task(cell.task)

    def play(num_episodes: int, seed: int) -> Evaluation:
        return evaluate(
            DefaultPolicy(learner, cell, trained),
            task.world_from(trained.config.world),
            task.goals,
            num_episodes=num_episodes,
            num_steps=EPISODE_STEPS,
            success_distance_m=SUCCESS_DISTANCE_M,
            seed=cell.seed + seed,
            num_threads=threads,
        )

    curve: list[dict[str, float]] = []
    wall_s = 0.0
    while learner.num_timesteps < cell.num_env_steps:
        begun = time.perf_counter()
        num = min(every, cell.num_env_steps - learner.num_timesteps)
        learner.learn(num, reset_num_timesteps=not curve, log_interval=None)  # type: ignore[arg-type]
        wall_s += time.perf_counter() - begun
        found = play(cell.curve_episodes, CURVE_SEED)
        rates = {"success_last": found.success_last, "success_ever": found.success_ever}
        curve.append({"env_steps": learner.num_timesteps, "wall_s": wall_s, **rates})
        print(f"{learner.num_timesteps:10,} env steps, {wall_s:6.0f} s: {found.success_last:.0%}", flush=True)
    settings = cell.model_dump(mode="json", include={"task", "method", "seed", "num_env_steps"})
    return {
        "machine": machine("torch", "mujoco", "stable-baselines3"),
        "settings": {"cell": settings, **describe(trained).of(cell.method), "threads": threads},
        "curve": curve,
        "evaluation": play(cell.num_episodes, FINAL_SEED).as_dict(),
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
        cell = make_cell(task=given.task, method=given.method, seed=given.seed, num_env_steps=given.steps)
        result = learn(cell, service.load_primitives(given.primitives), every=given.every, threads=given.threads)
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
