"""The learning loop of whatever code is in the current directory, such as an old commit's; see ``compare_commits.py``.

    python loop_probe.py train RUN_DIR CONFIG ENV_STEPS     pre-train so long from scratch
    python loop_probe.py measure RUN_DIR NUM_ITERATIONS     go on from there, and print what so many iterations took

Nothing of ours is used but what all the commits compared have: the configuration, the run directory, the local runner.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

# before NumPy is imported: as the command line does
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import service
from service.config import load_config
from service.io.run_directory import RunDirectory
from service.runtime.local import LocalRun

NUM_WARMUP_ITERATIONS = 2
"""After a start, before it is measured; the first has nothing to learn from but the round that was saved."""
ENDLESS = "run.total_env_steps=1000000000000"


def train(directory: RunDirectory, config_file: Path, num_env_steps: int) -> None:
    """Pre-train from scratch."""
    config = load_config(config_file, [f"run.total_env_steps={num_env_steps}"])
    LocalRun(config, directory).run()


def measure(directory: RunDirectory, num_iterations: int) -> dict[str, float]:
    """Go on from the newest checkpoint.

    Returns:
        Env steps, wall-clock seconds and CPU seconds of ``num_iterations`` iterations, after some to warm up.
    """
    run = LocalRun(load_config(directory.config_file, [ENDLESS]), directory, resume=True)
    marks: list[tuple[float, float, float]] = []

    def on_iteration(metrics: dict[str, float]) -> None:
        marks.append((metrics["env_steps"], time.perf_counter(), time.process_time()))
        if len(marks) == NUM_WARMUP_ITERATIONS + num_iterations:
            run.request_stop()

    run.run(on_iteration)
    first, last = marks[NUM_WARMUP_ITERATIONS - 1], marks[-1]
    return dict(zip(("num_steps", "wall_s", "cpu_s"), (b - a for a, b in zip(first, last, strict=True)), strict=True))


def main() -> None:
    """Do what the command line says, with the code of the current directory and no other."""
    assert Path(service.__file__).resolve().parents[1] == Path.cwd().resolve(), f"service is {service.__file__}"
    verb, run_dir, *arguments = sys.argv[1:]
    directory = RunDirectory(Path(run_dir))
    if verb == "train":
        train(directory, Path(arguments[0]), int(arguments[1]))
    else:
        print(json.dumps(measure(directory, int(arguments[0]))))
    directory.close()


if __name__ == "__main__":
    main()
