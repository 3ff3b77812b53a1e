"""The JSON files of downstream trainings and of the table: read, checked and written. No physics is imported for it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from service.errors import TandemError
from service.io.files import os_errors, write_atomic
from service.parsing import ParseError, parse_json
from service.regular_files import read_regular

RESULT_FILE = "result.json"
FORMAT_VERSION = 1
"""Version of both, and of the table's files."""
TRIAL = "cell"
"""Key of a trial's settings in these files, which call a trial a cell."""
Result = dict[str, Any]
"""What a result's file has."""
MAX_BYTES = 64 * 1024 * 1024
"""Of each of them, whose curves grow with the length of a training."""


def made_with(tree: dict[str, Any]) -> dict[str, Any]:
    """Primitives and world in what was read from a file, as of ``methods.provenance``."""
    return {key: tree.get(key) for key in ("primitives", "world")}


def read_json(path: Path) -> dict[str, Any]:
    """Read the object in a file.

    Raises:
        TandemError: there is none, or it is of another format version.
    """
    with os_errors("read", path):
        data = read_regular(path, MAX_BYTES, follow=True)
    try:
        tree = dict(parse_json(data, path))
    except ParseError as error:
        raise TandemError(f"{path} is no JSON object: {error.reason}; remove it, or name another directory") from None
    except (ValueError, TypeError) as error:
        raise TandemError(f"{path} is no JSON object: {error}; remove it, or name another directory") from None
    _check_version(tree, path)
    return tree


class _Evaluation(BaseModel):
    success_last: float
    success_last_low: float
    success_last_high: float
    success_ever: float
    num_episodes: int


class _Point(BaseModel):
    env_steps: float
    success_last: float


class _Primitives(BaseModel):
    name: str
    env_steps: float | None = None


class _Made(BaseModel):
    git_commit: str | None


class _Result(BaseModel):
    """The parts of a result that commands and pages show; there are others."""

    model_config = ConfigDict(allow_inf_nan=False)
    evaluation: _Evaluation
    primitives: _Primitives | None
    made: _Made
    env_steps: float
    wall_s: float
    curve: list[_Point]


def read_result(path: Path) -> dict[str, Any]:
    """Read the result of a training.

    Raises:
        TandemError: as for ``read_json``; or it is no result.
    """
    tree = read_json(path)
    try:
        _Result.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise TandemError(f"{path} is no result: {where}: {first['msg']}; remove it, and it is made again") from None
    return tree


def _check_version(tree: dict[str, Any], path: Path) -> None:
    found = tree.get("format_version")
    if found != FORMAT_VERSION:
        raise TandemError(
            f"{path}: format version {found!r}, this program reads {FORMAT_VERSION}; name another directory"
        )


def write_json(path: Path, tree: dict[str, Any]) -> None:
    """Put an object into a file in one step.

    Raises:
        TandemError: the file cannot be written.
    """
    with os_errors("write", path):
        write_atomic(path, to_json(tree))


def to_json(tree: dict[str, Any]) -> bytes:
    """An object as the files have it."""
    return (json.dumps(tree, indent=1, allow_nan=False) + "\n").encode()
