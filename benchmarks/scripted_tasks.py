"""Show that each downstream task can be solved in its 50 steps: a hand-written policy on random episodes.

    python -m benchmarks.scripted_tasks --out docs/results/scripted_tasks.json

Success counts as in the paper's table, within 5 cm of the goal at the last step. Beside it stands a policy that does
nothing.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

# before NumPy is imported: as the command line does
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from benchmarks.measuring import machine, write_json
from benchmarks.scripted import play_task
from service.actors.evaluation import wilson_interval
from service.config import WorldConfig
from service.envs.gym.registration import EPISODE_STEPS
from service.envs.tasks import TASKS

PACKAGES = ("mujoco", "numpy")
SEED = 0
PHYSICS = {
    "2 ms x 20": WorldConfig(),
    "5 ms x 8 (pre-training)": WorldConfig(physics_step_s=0.005, num_substeps=8),
}


def measure_task(task: str, config: WorldConfig, num_episodes: int) -> dict[str, Any]:
    """One task, played by the script and by nobody."""
    played = play_task(task, config, num_episodes=num_episodes, seed=SEED)
    idle = play_task(task, config, num_episodes=num_episodes, seed=SEED, idle=True)
    num_solved = int(played.success_last.sum())
    low, high = wilson_interval(num_solved, num_episodes)
    median, slowest = (int(np.quantile(played.first_step, share, method="higher")) for share in (0.5, 0.95))
    return {
        "success_last": num_solved / num_episodes,
        "success_last_low": low,
        "success_last_high": high,
        "success_ever": len(played.first_step) / num_episodes,
        "median_step": median,
        "p95_step": slowest,
        "idle_success_last": float(idle.success_last.mean()),
    }


def main() -> int:
    """Parse the command line, play, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, metavar="FILE", default=Path("docs/results/scripted_tasks.json"))
    parser.add_argument("--episodes", type=int, default=300, help="of each task")
    given = parser.parse_args()
    physics: dict[str, Any] = {}
    for words, config in PHYSICS.items():
        physics[words] = {task: measure_task(task, config, given.episodes) for task in TASKS}
        for task, row in physics[words].items():
            print(f"{words:>26} {task:>7}: {row['success_last']:.3f} (idle {row['idle_success_last']:.3f})")
    settings = {"num_episodes": given.episodes, "num_steps": EPISODE_STEPS, "seed": SEED}
    write_json(given.out, {"recorded": machine(*PACKAGES), "settings": settings, "physics": physics})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
