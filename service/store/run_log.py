"""What happened to a run, a line of JSON each: who died, who came back, what went wrong and how the run ended.

It is what the process that runs it says on its way (``logging``), kept where a later reader of the run finds it.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from io import BufferedWriter, TextIOWrapper
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Literal

from pydantic import AwareDatetime

from service.base.files import open_to_append, read_regular
from service.base.parsing import ParseError, parse_with
from service.config.frozen import FrozenModel

FILE = "log.jsonl"
MAX_FILE_BYTES = 1024 * 1024
"""A longer file is put aside as ``log.jsonl.1``, and the one that was there before goes."""
_MAX_TEXT = 2000
_LOGGER = logging.getLogger("service")


class LogLine(FrozenModel):
    """One thing that happened."""

    at: AwareDatetime
    level: Literal["info", "warning", "error"]
    text: str


@contextmanager
def logging_to(directory: Path) -> Iterator[Callable[[str], None]]:
    """Keep, in the block, what ``service`` logs in a run directory; the caller has the directory's lock.

    A disk that is full loses lines, and stops nothing.

    Yields:
        A function that writes a line that is of no use on a terminal.
    """
    handler = _Handler(directory / FILE, maxBytes=MAX_FILE_BYTES, backupCount=1, delay=True)
    handler.setFormatter(_Formatter())
    handler.setLevel(logging.INFO)

    def note(text: str, level: int = logging.INFO) -> None:
        handler.handle(logging.LogRecord("service", level, __file__, 0, text, None, None))

    _LOGGER.addHandler(handler)
    try:
        yield note
    except Exception as error:
        note(f"the run failed: {error}", logging.ERROR)
        raise
    finally:
        _LOGGER.removeHandler(handler)
        with suppress(OSError):  # it writes once more what did not fit, and must not hide why the run ended
            handler.close()


class _Handler(RotatingFileHandler):
    def _open(self) -> TextIOWrapper:
        return TextIOWrapper(BufferedWriter(open_to_append(Path(self.baseFilename))), encoding="utf-8")

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        """Go on without the line."""


class _Formatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        """One line of JSON, of one line of text."""
        at = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        level = "info" if record.levelno < logging.WARNING else "warning" if record.levelno < logging.ERROR else "error"
        return json.dumps({"at": at, "level": level, "text": " ".join(record.getMessage().split())[:_MAX_TEXT]})


def read_log(directory: Path) -> list[LogLine]:
    """Read what happened to a run, oldest first; what is no line of a log is passed over, and no file is no line."""
    lines = []
    for name in (f"{FILE}.1", FILE):
        try:
            data = read_regular(directory / name, 2 * MAX_FILE_BYTES)
        except OSError:
            continue
        for line in data.splitlines():
            try:
                lines.append(parse_with(LogLine.model_validate_json, line, name))
            except ParseError:  # a torn line of a process that was killed
                continue
    return lines
