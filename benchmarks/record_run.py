"""Make the small file of a run that ``docs/results`` keeps and the report is made from.

    python -m benchmarks.record_run runs/cube --out docs/results/runs/cube-0.json

It holds the configuration, the metrics thinned to at most 300 points, a sample of the goals in the layout of
``goals.jsonl`` and counts of all of them, and what is measured here: the newest Bob on every task (``tasks.py``), and
the coverage of random compositions at three stages of training (``stages.py``). That takes a minute or two.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.curriculum import count_goals
from benchmarks.measuring import machine, write_json
from benchmarks.run_files import FORMAT_VERSION, Records, Run, blocks, thin
from benchmarks.stages import measure_coverage
from benchmarks.tasks import measure_tasks
from service.errors import TandemError
from service.io.run_directory import RunDirectory
from service.media.plots.figures import read_records
from service.policies.evaluator import bob_evaluator
from service.primitives.loading import read_stages

GOAL_RECORDS, GOALS_EACH = 60, 10
"""Stages of the run of which goals are kept, and the number of goals of each."""
PACKAGES = ("mujoco", "numpy", "torch")


def record_run(directory: RunDirectory, name: str, note: str = "") -> Run:
    """Everything that is kept of a run without measuring anything.

    Args:
        directory: the run.
        name: what tables and pictures call it.
        note: for people.

    Raises:
        TandemError: not a run, or one that has no iteration yet, or damaged.
    """
    config = directory.read_config()
    goals = read_records(directory.goals_file)
    return {
        "format_version": FORMAT_VERSION,
        "name": name,
        "note": note,
        "recorded": machine(*PACKAGES),
        "environment": _environment(directory),
        "config": config.model_dump(mode="json"),
        "series": thin(read_records(directory.metrics_file)),
        "curriculum": count_goals(goals, config.world.object_size_m / 2),
        "goals": sample_goals(goals),
    }


def measure_run(directory: RunDirectory) -> dict[str, Any]:
    """Evaluations of a run's newest Bob on every task, and the coverage at all stages.

    Raises:
        TandemError: not a run, or without a usable checkpoint.
    """
    config, bobs = directory.read_config(), read_stages(directory)
    newest = bob_evaluator(bobs[max(bobs)])
    return {"evaluations": measure_tasks(newest, config), "coverage": measure_coverage(bobs, config)}


def sample_goals(records: Records) -> list[dict[str, Any]]:
    """Records of ``goals.jsonl``, joined to at most 60 stages with at most 10 goals each, evenly taken."""
    kept = []
    for block in blocks(len(records), GOAL_RECORDS):
        goals = [goal for index in block for goal in records[index]["goals"]]
        chosen = sorted({round(place) for place in np.linspace(0, len(goals) - 1, GOALS_EACH)}) if goals else []
        kept.append({"env_steps": records[block[-1]]["env_steps"], "goals": [goals[index] for index in chosen]})
    return kept


def _environment(directory: RunDirectory) -> dict[str, Any]:
    """Commit and versions the run was last started with."""
    path = directory.path / "environment.json"
    environment: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return environment


def main() -> int:
    """Parse the command line, read, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path, metavar="RUN_DIR")
    parser.add_argument("--out", type=Path, metavar="FILE", required=True, help="its stem is the run's name")
    parser.add_argument("--note", default="", help="a sentence for people")
    given = parser.parse_args()
    directory = RunDirectory(given.run_dir)
    try:
        write_json(given.out, record_run(directory, given.out.stem, given.note) | measure_run(directory))
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{given.out}: {given.out.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
