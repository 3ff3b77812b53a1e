"""The history of a run: its identity and version, and what was not as before when a process went on with it."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from pydantic import AwareDatetime, Field, JsonValue

from service.base.errors import StorageError
from service.base.files import os_errors, read_regular, write_atomic
from service.base.parsing import ParseError, parse_with
from service.base.version import __version__
from service.config.frozen import FrozenModel
from service.store.models import MAX_BYTES

FILE = "run.json"
BEFORE = "0.2"
"""The version that reads runs which do not say their version: its own, and those of 0.1, which have no ``run.json``."""
_Note = TypeVar("_Note")


class Event(FrozenModel):
    """What was not as before when a process went on."""

    at: AwareDatetime
    after_iteration: int = Field(ge=0)
    changed: dict[str, tuple[JsonValue, JsonValue]] = Field({}, description="settings: what they were, what they are")
    damaged_records: tuple[str, ...] = Field((), description="what is lost of the records")


class RunHistory(FrozenModel):
    """Content of ``run.json``."""

    run: str = Field(pattern=r"^[0-9a-f]{32}$", description="identity, drawn at random when the run began")
    tandem: str = Field(BEFORE, description="version that began the run")
    events: tuple[Event, ...] = ()

    @classmethod
    def new(cls) -> RunHistory:
        """The history of a run that begins."""
        return cls(run=secrets.token_hex(16), tandem=__version__)

    def write(self, directory: Path) -> None:
        """Put it into a run directory.

        Raises:
            StorageError: it cannot be written.
        """
        write_atomic(directory / FILE, self.model_dump_json(indent=1).encode() + b"\n")


def of_another_version(path: Path, reader: str) -> str:
    """Say that another version has written this, and which version reads it."""
    return f"{path} is of another version of tandem, which this one does not read: use tandem {reader}"


def is_of_this_version(version: str) -> bool:
    """Whether this version goes on with the runs of another one: until 1.0, those of its own minor version."""
    return version.split(".")[:2] == __version__.split(".")[:2]


def read_history(directory: Path) -> RunHistory | None:
    """Read a run's history; None where there is none, as of a run of version 0.1.

    Raises:
        StorageError: it cannot be read, or is damaged.
    """
    return read_note(directory / FILE, RunHistory.model_validate_json)


def read_note(path: Path, parser: Callable[[bytes], _Note]) -> _Note | None:
    """Read a file of JSON in a run directory; None where there is none.

    Args:
        path: of the file.
        parser: makes a value of its content, or raises an error.

    Raises:
        StorageError: it cannot be read, or is damaged.
    """
    with os_errors("read", path):
        try:
            data = read_regular(path, MAX_BYTES, follow=True)
        except FileNotFoundError:
            return None
    try:
        return parse_with(parser, data, path)
    except ParseError:
        hint = "restore it from a copy" if path.name == FILE else "restore it from a copy, or remove it"
        raise StorageError(f"{path} is damaged; {hint}") from None
