"""Make the small file of a skill-discovery run, or of self-play as skills, that ``docs/results/skills`` keeps.

    python -m benchmarks.record_skills runs/lsd-0 --out docs/results/skills/lsd-0.json

It holds the configuration, the metrics thinned to at most 100 points, and the coverage of random skills at three stages
of training (``stages.py``), all of 50 steps, an episode of the downstream tasks. Of self-play a skill is a random
composition of the primitives. That takes a minute.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.measuring import machine, write_json
from benchmarks.record_run import PACKAGES
from benchmarks.run_files import COUNTERS, FORMAT_VERSION, Run, thin
from benchmarks.stages import measure_coverage
from service.envs.gym.registration import EPISODE_STEPS
from service.errors import TandemError
from service.io.run_directory import RunDirectory
from service.media.figures import read_records
from service.primitives.loading import read_stages

OURS = "ours"
"""Name of self-play among the methods."""
MAX_POINTS = 100
KEPT = (*COUNTERS, "evaluation/coverage", "skills/", "bob/env_steps_fraction")
"""Beginnings of the names of metrics that are kept."""


def record_skills(directory: RunDirectory, name: str, note: str = "") -> Run:
    """Everything that is kept of a run; ``name`` is for tables, ``note`` for people.

    Raises:
        TandemError: no run, or one of a monolithic Bob, who has no skills.
    """
    config = directory.read_config()
    coverage = measure_coverage(read_stages(directory), config, num_steps=EPISODE_STEPS)
    if coverage is None:
        raise TandemError(f"{directory.path} has a monolithic Bob, who has no skills; name another run")
    kept = [
        {key: value for key, value in record.items() if key.startswith(KEPT)}
        for record in read_records(directory.metrics_file)
    ]
    return {
        "format_version": FORMAT_VERSION,
        "name": name,
        "note": note,
        "method": OURS if config.skills is None else config.skills.method,
        "recorded": machine(*PACKAGES),
        "config": config.model_dump(mode="json"),
        "series": thin(kept, MAX_POINTS),
        "coverage": coverage,
    }


def main() -> int:
    """Parse the command line, read, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path, metavar="RUN_DIR")
    parser.add_argument("--out", type=Path, metavar="FILE", required=True, help="its stem is the run's name")
    parser.add_argument("--note", default="", help="a sentence for people")
    given = parser.parse_args()
    try:
        write_json(given.out, record_skills(RunDirectory(given.run_dir), given.out.stem, given.note))
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{given.out}: {given.out.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
