"""Recorded trainings of tasks, one JSON file each, which ``benchmarks/trials.py`` writes: read, and put in order."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from service.base.errors import TandemError

TRIAL = "cell"
"""Key of a trial's settings in these files, which call a trial a cell."""
FORMAT_VERSION = 1
Result = dict[str, Any]


class _Evaluation(BaseModel):
    success_last: float
    success_ever: float
    num_episodes: int


class _Result(BaseModel):
    """The parts of a result that pages show; there are others."""

    model_config = ConfigDict(allow_inf_nan=False)
    format_version: int
    cell: dict[str, Any]
    evaluation: _Evaluation
    primitives: dict[str, Any] | None
    made: dict[str, Any]
    env_steps: float
    wall_s: float
    curve: list[dict[str, float]]


def read_trials(directory: Path) -> list[Result]:
    """Every result of a directory, by task, method and seed."""
    found = []
    for path in sorted(directory.glob("*.json")):
        try:
            result = json.loads(path.read_text(encoding="utf-8"))
            _Result.model_validate(result)
        except (OSError, ValueError) as error:
            first = error.errors()[0] if isinstance(error, ValidationError) else None
            why = f"{'.'.join(map(str, first['loc']))}: {first['msg']}" if first else error
            raise TandemError(f"{path} is no result: {why}; remove it, and reproduce it") from None
        if result["format_version"] != FORMAT_VERSION:
            raise TandemError(
                f"{path}: format version {result['format_version']!r}, this program reads {FORMAT_VERSION}"
            )
        found.append(result)
    return found


def by_method_and_task(results: Sequence[Result]) -> dict[tuple[str, str], list[Result]]:
    """Results of the seeds of each method on each task, in the order of the seeds."""
    found: dict[tuple[str, str], list[Result]] = {}
    for result in sorted(results, key=lambda each: int(each[TRIAL]["seed"])):
        found.setdefault((result[TRIAL]["method"], result[TRIAL]["task"]), []).append(result)
    return found
