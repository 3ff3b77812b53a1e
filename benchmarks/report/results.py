"""Recorded trainings of tasks, one JSON file each, which ``benchmarks/trials.py`` writes: read, and put in order."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

TRIAL = "cell"
"""Key of a trial's settings in these files, which call a trial a cell."""
FORMAT_VERSION = 1
Result = dict[str, Any]


def read_trials(directory: Path) -> list[Result]:
    """Every result of a directory, by task, method and seed."""
    return [json.loads(path.read_text(encoding="utf-8")) for path in sorted(directory.glob("*.json"))]


def by_method_and_task(results: Sequence[Result]) -> dict[tuple[str, str], list[Result]]:
    """Results of the seeds of each method on each task, in the order of the seeds."""
    found: dict[tuple[str, str], list[Result]] = {}
    for result in sorted(results, key=lambda each: int(each[TRIAL]["seed"])):
        found.setdefault((result[TRIAL]["method"], result[TRIAL]["task"]), []).append(result)
    return found
