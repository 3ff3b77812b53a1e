"""Make the small file of a run that ``docs/results`` keeps and ``figures.py`` draws from.

    python benchmarks/record_run.py runs/cube --out docs/results/runs/cube-0.json --evaluation table.json air.json

A run of hours has thousands of iterations. Consecutive ones are joined to at most 300 points: a point holds the mean
of each metric over the iterations that have it, and the last value of the counters (iteration, env steps, wall-clock
time). A sample of the goals is kept in the layout of ``goals.jsonl``, all of the configuration, and the evaluations
given, which ``tandem evaluate --json`` prints.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring import machine, write_json
from service.errors import TandemError
from service.runtime.plots.figures import column, read_records
from service.runtime.rundir import RunDirectory

FORMAT_VERSION = 1
MAX_POINTS = 300
"""Of every series."""
GOAL_RECORDS, GOALS_EACH = 60, 10
"""Stages of the run of which goals are kept, and how many of each."""
COUNTERS = ("iteration", "env_steps", "time/wall_s")
EVALUATION_KEYS = ("goals", "num_episodes", "success_last", "success_last_low", "success_last_high", "success_ever")
PACKAGES = ("mujoco", "numpy", "torch")
_DIGITS = 5

Records = Sequence[dict[str, Any]]


def record_run(directory: RunDirectory, name: str, evaluations: Records = (), note: str = "") -> dict[str, Any]:
    """Everything that is kept of a run.

    Args:
        directory: the run.
        name: what tables and pictures call it.
        evaluations: rows of ``tandem evaluate``, each with the ``policy`` it is of.
        note: for people.

    Raises:
        TandemError: not a run, or one that has no iteration yet, or damaged.
    """
    config = directory.read_config()
    return {
        "format_version": FORMAT_VERSION,
        "name": name,
        "note": note,
        "recorded": machine(*PACKAGES),
        "environment": _environment(directory),
        "config": config.model_dump(mode="json"),
        "evaluations": list(evaluations),
        "series": thin(read_records(directory.metrics_file)),
        "goals": sample_goals(read_records(directory.goals_file)),
    }


def thin(records: Records, max_points: int = MAX_POINTS) -> dict[str, list[float | None]]:
    """Each metric as a list of at most ``max_points`` means over equal blocks of records; null where none had it."""
    blocks = _blocks(len(records), max_points)
    keys = sorted({key for record in records for key in record}, key=lambda key: (key not in COUNTERS, key))
    series = {}
    for key in keys:
        values = column(records, key)
        points = [values[block][-1:] if key in COUNTERS else values[block] for block in blocks]
        series[key] = [_rounded(point[np.isfinite(point)], key) for point in points]
    return series


def unthin(series: dict[str, list[float | None]]) -> list[dict[str, Any]]:
    """A record for each point, as ``metrics.jsonl`` has them: what was null is left out."""
    rows = zip(*series.values(), strict=True)
    return [{key: value for key, value in zip(series, row, strict=True) if value is not None} for row in rows]


def sample_goals(records: Records) -> list[dict[str, Any]]:
    """Records of ``goals.jsonl``, joined to at most 60 stages with at most 10 goals each, evenly taken."""
    kept = []
    for block in _blocks(len(records), GOAL_RECORDS):
        goals = [goal for index in block for goal in records[index]["goals"]]
        chosen = sorted({round(place) for place in np.linspace(0, len(goals) - 1, GOALS_EACH)}) if goals else []
        kept.append({"env_steps": records[block[-1]]["env_steps"], "goals": [goals[index] for index in chosen]})
    return kept


def _environment(directory: RunDirectory) -> dict[str, Any]:
    """Commit and versions the run was last started with."""
    path = directory.path / "environment.json"
    environment: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return environment


def read_evaluation(path: Path) -> list[dict[str, Any]]:
    """What ``tandem evaluate --json`` printed, a row for each policy.

    Raises:
        TandemError: the file cannot be read, or holds something else.
    """
    try:
        rows = [{"policy": policy, **row} for policy, row in json.loads(path.read_text(encoding="utf-8")).items()]
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise TandemError(f"cannot read {path}: {error}; give what `tandem evaluate --json` prints") from error
    for row in rows:
        missing = [key for key in EVALUATION_KEYS if key not in row]
        if missing:
            raise TandemError(f"{path}: {row['policy']} has no {missing[0]}; give what `tandem evaluate --json` prints")
    return rows


def _blocks(num: int, max_blocks: int) -> list[NDArray[np.int64]]:
    return np.array_split(np.arange(num), min(num, max_blocks))


def _rounded(values: NDArray[np.float64], key: str) -> float | None:
    if not values.size:
        return None
    mean = float(values.mean())
    return int(mean) if key in ("iteration", "env_steps") else float(f"{mean:.{_DIGITS}g}")


def main() -> int:
    """Parse the command line, read, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path, metavar="RUN_DIR")
    parser.add_argument("--out", type=Path, metavar="FILE", required=True, help="its stem is the run's name")
    parser.add_argument(
        "--evaluation", type=Path, metavar="FILE", nargs="*", default=[], help="of `tandem evaluate --json`"
    )
    parser.add_argument("--note", default="", help="a sentence for people")
    given = parser.parse_args()
    try:
        evaluations = [row for path in given.evaluation for row in read_evaluation(path)]
        write_json(given.out, record_run(RunDirectory(given.run_dir), given.out.stem, evaluations, given.note))
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{given.out}: {given.out.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
