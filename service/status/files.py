"""Files over HTTP: pictures and videos of runs, and blobs, in ranges and with entity tags."""

from __future__ import annotations

import os
import re
import stat
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fastapi import Request
from starlette.responses import FileResponse, Response

from service.status.openapi import problems
from service.status.problems import ProblemError
from service.status.shapes import RunFile
from service.store.disk_reader import run_id_of

RUN_FILES = {
    "rounds.mp4": ("Alice beside Bob", "video/mp4"),
    "curves.png": ("Curves", "image/png"),
    "goals.png": ("Goals", "image/png"),
    "coverage.png": ("Where random compositions move the object", "image/png"),
}
"""Title and media type of what may leave a run directory; nothing else does."""
BYTES = {"schema": {"type": "string", "format": "binary"}}
"""Of a file, in the OpenAPI document."""
PARTS: dict[int | str, dict[str, Any]] = {
    206: {"description": "The range that was asked for."},
    304: {"description": "Not changed since the entity tag that was given."},
    **problems((416, "The range lies beyond the file.")),
}
"""Answers of a route that gives a file, beside 200."""
_RANGE = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")


class RunDirectories:
    """The directories of runs, for their pictures and videos."""

    def __init__(self, root: Path | None) -> None:
        """For ``root``/*/; None where runs have no directories here."""
        self._root = root

    def files(self, run_id: str) -> list[RunFile]:
        """What there is of ``RUN_FILES``; empty also where there is no such directory."""
        found = ((name, self._stat(run_id, name)) for name in RUN_FILES)
        return [
            RunFile(
                name=name,
                title=RUN_FILES[name][0],
                media_type=RUN_FILES[name][1],
                num_bytes=status.st_size,
                modified=datetime.fromtimestamp(status.st_mtime, UTC),
                url=f"/v1/runs/{run_id}/files/{name}",
            )
            for name, status in found
            if status is not None
        ]

    def path(self, run_id: str, name: str) -> Path:
        """Where one of them is.

        Raises:
            ProblemError: the run has no such file.
        """
        if name not in RUN_FILES or self._stat(run_id, name) is None:
            there = ", ".join(file.name for file in self.files(run_id)) or "nothing yet"
            raise ProblemError(404, "no-such-file", f"run {run_id} has no {name[:64]!r} to show; it has: {there}")
        directory = self._directory(run_id)
        assert directory is not None
        return directory / name

    def _stat(self, run_id: str, name: str) -> os.stat_result | None:
        directory = self._directory(run_id)
        try:
            status = os.stat(directory / name) if directory is not None else None
        except OSError:
            return None
        return status if status is not None and stat.S_ISREG(status.st_mode) else None

    def _directory(self, run_id: str) -> Path | None:
        """Looked up and not put together, so that no id leads anywhere else."""
        try:
            found = sorted(self._root.iterdir()) if self._root is not None else []
        except OSError:
            return None
        return next((path for path in found if path.is_dir() and run_id_of(path) == run_id), None)


def file_response(request: Request, path: Path, media_type: str, *, etag: str | None = None, cache: str) -> Response:
    """The file, the range of it that was asked for, or 304.

    Args:
        request: its If-None-Match, If-Range and Range count.
        path: of a regular file.
        media_type: of its content.
        etag: without quotation marks; made of size and time where left out.
        cache: the header Cache-Control.

    Raises:
        ProblemError: 416, the range lies beyond the file.
    """
    status = os.stat(path)
    tag = f'"{etag or f"{status.st_mtime_ns:x}-{status.st_size:x}"}"'
    headers = {"etag": tag, "cache-control": cache}
    if tag in _tags(request.headers.get("if-none-match", "")):
        return Response(status_code=304, headers=headers)
    _check_range(request, tag, status.st_size)
    return FileResponse(path, headers=headers, media_type=media_type, stat_result=status)


def _tags(header: str) -> set[str]:
    """The tags of an If-None-Match, which compares them weakly."""
    return {tag.strip().removeprefix("W/") for tag in header.split(",")}


def _check_range(request: Request, tag: str, size: int) -> None:
    """Leave a Range to Starlette if it is one; take it away if it does not count, which gives the whole file."""
    asked = _RANGE.fullmatch(request.headers.get("range", "").strip())
    start, end = asked.groups() if asked else ("", "")
    counts = bool(start or end) and request.headers.get("if-range", tag).strip() == tag
    if counts and start and end and int(end) < int(start):
        counts = False
    if not counts:
        request.scope["headers"] = [pair for pair in request.scope["headers"] if pair[0] != b"range"]
    elif (start and int(start) >= size) or (not start and int(end) == 0):
        raise ProblemError(416, "no-such-range", f"the file has {size} bytes", {"Content-Range": f"bytes */{size}"})
