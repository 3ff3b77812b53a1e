"""Recorded files, of which those of ``benchmarks/trials.py`` are put in order."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

TRIAL = "cell"
"""Key of a trial's settings in these files, which call a trial a cell."""
Result = dict[str, Any]


def read_all(directory: Path, names: Collection[str] | None = None) -> dict[str, Result]:
    """Recorded files of a directory by their names, in order; of ``names``, those that are there."""
    paths = (path for path in sorted(directory.glob("*.json")) if names is None or path.stem in names)
    return {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in paths}


def by_method_and_task(results: Sequence[Result]) -> dict[tuple[str, str], list[Result]]:
    """Results of the seeds of each method on each task, in the order of the seeds."""
    found: dict[tuple[str, str], list[Result]] = {}
    for result in sorted(results, key=lambda each: int(each[TRIAL]["seed"])):
        found.setdefault((result[TRIAL]["method"], result[TRIAL]["task"]), []).append(result)
    return found
