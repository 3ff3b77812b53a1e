"""Files over HTTP: pictures and videos of runs, and blobs, with ranges and entity tags."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fastapi import Request
from starlette.responses import FileResponse, Response
from starlette.staticfiles import NotModifiedResponse, StaticFiles

from service.base.files import open_regular
from service.status.problems import ProblemError, problems
from service.status.schemas import RunFile
from service.store.run_directory import RECORDINGS

RUN_FILES = {
    "rounds.mp4": ("Alice beside Bob", "video/mp4"),
    "skills.mp4": ("Random skills", "video/mp4"),
    "episodes.mp4": ("Episodes of the task", "video/mp4"),
    "curves.png": ("Curves", "image/png"),
    "goals.png": ("Goals", "image/png"),
    "coverage.png": ("Where random skills move the object", "image/png"),
}
"""Title and media type of the files of a run directory that are served; all others are not."""
OLDER = re.compile(r"(rounds|skills|episodes)-[0-9]{8}T[0-9]{6}\.mp4")
"""Name of a recording that a newer one has replaced."""
BYTES = {"schema": {"type": "string", "format": "binary"}}
"""The content of a file in the OpenAPI document."""
PARTS: dict[int | str, dict[str, Any]] = {
    206: {"description": "The requested range."},
    304: {"description": "Not changed since the given entity tag."},
    **problems((416, "The range lies beyond the file.")),
}
"""Answers of a route that gives a file, in addition to 200."""
_RANGE = re.compile(r"([0-9]{1,20})-([0-9]{0,20})|-([0-9]{1,20})")
_CONDITIONS = StaticFiles()
"""Starlette's class, whose ``is_not_modified`` compares a file with what a client has."""


def kind_of(name: str) -> tuple[str, str]:
    """Title and media type of a file that is served."""
    older = OLDER.fullmatch(name)
    return RUN_FILES[f"{older[1]}.mp4" if older else name]


def run_files(directory: Path | None, run_id: str) -> list[RunFile]:
    """List those of ``RUN_FILES`` and older recordings that a run's directory has; empty if it has no directory."""
    found = []
    for name, path in _paths(directory).items():
        title, media_type = kind_of(name)
        with suppress(OSError):  # it may be deleted meanwhile
            status = path.stat()
            found.append(
                RunFile(
                    name=name,
                    title=title,
                    media_type=media_type,
                    num_bytes=status.st_size,
                    modified=datetime.fromtimestamp(status.st_mtime, UTC),
                    url=f"/v1/runs/{run_id}/files/{name}",
                )
            )
    return found


def find_file(directory: Path | None, run_id: str, name: str) -> Path:
    """Find one of them.

    Raises:
        ProblemError: the run has no such file.
    """
    paths = _paths(directory)
    if name not in paths:
        there = ", ".join(paths) or "nothing yet"
        raise ProblemError(404, "no-such-file", f"run {run_id} has no {name[:64]!r} to show; it has: {there}")
    return paths[name]


def _paths(directory: Path | None) -> dict[str, Path]:
    if directory is None:
        return {}
    paths = {name: directory / name for name in RUN_FILES}
    with suppress(OSError):  # most runs have no older recordings
        older = sorted((directory / RECORDINGS).iterdir(), reverse=True)
        paths |= {path.name: path for path in older if OLDER.fullmatch(path.name)}
    return {name: path for name, path in paths.items() if os.path.isfile(path) and not os.path.islink(path)}


def file_response(
    request: Request, path: Path, media_type: str, *, etag: str | None = None, cache: str = "no-cache"
) -> Response:
    """Answer with the file, the requested range of it, or 304.

    If-None-Match, If-Modified-Since, Range and If-Range count; a Range that is malformed or in another unit does not
    (RFC 9110, section 14.2). ``etag`` has no quotation marks and is made from time and size if None; ``cache`` is the
    header Cache-Control.

    Raises:
        ProblemError: 416, a range lies beyond the file; 404, it cannot be read.
    """
    headers = {"cache-control": cache, **({"etag": f'"{etag}"'} if etag else {})}
    try:
        with open_regular(path, follow=True) as file:
            status = os.fstat(file.fileno())
    except OSError as error:
        raise ProblemError(404, "no-such-file", f"{path.name} cannot be read: {error.strerror}") from None
    response = FileResponse(path, headers=headers, media_type=media_type, stat_result=status)
    if _CONDITIONS.is_not_modified(response.headers, request.headers):
        return NotModifiedResponse(response.headers)
    begins = _begins(request.headers.get("range", ""), status.st_size)
    beyond = [begin >= status.st_size for begin in begins]
    if begins and all(beyond) and "if-range" not in request.headers:
        length = {"Content-Range": f"bytes */{status.st_size}"}
        raise ProblemError(416, "no-such-range", f"the file has {status.st_size} bytes", length)
    if not begins or any(beyond):  # starlette would answer it with plain text
        request.scope["headers"] = [each for each in request.scope["headers"] if each[0] != b"range"]
    return response


def _begins(asked: str, num_bytes: int) -> list[int]:
    """Where the ranges of a Range header begin; none where it is not well-formed, or has no bytes as its unit."""
    unit, _, ranges = asked.partition("=")
    begins = []
    for text in ranges.split(","):
        each = _RANGE.fullmatch(text.strip())
        if unit.lower() != "bytes" or each is None or (each[2] and int(each[2]) < int(each[1])):
            return []
        begins.append(int(each[1]) if each[1] else max(0, num_bytes - int(each[3])))
    return begins
