"""Movable aliases of one name: files in a directory that each hold the number of a version."""

from __future__ import annotations

import fcntl
from pathlib import Path

from service.base.errors import RegistryError
from service.base.files import open_to_append, os_errors, read_regular, write_atomic
from service.registry.names import check_alias, is_name, is_number

MAX_BYTES = 100
"""Of an alias' file, which holds a number."""


def read_alias(directory: Path, alias: str) -> int | None:
    """The number ``alias`` means; None when there is no such alias.

    Raises:
        RegistryError: a bad alias, or its file is damaged.
        StorageError: the file cannot be read.
    """
    path = directory / check_alias(alias)
    with os_errors("read", path):
        try:
            text = read_regular(path, MAX_BYTES, follow=True).decode("ascii", errors="replace").strip()
        except FileNotFoundError:
            return None
    if not is_number(text):  # of so few bytes, it is no number that could not be worked with
        raise RegistryError(f"alias {path} is damaged: it holds {text!r}; set it again with tandem registry alias")
    return int(text)


def read_aliases(directory: Path) -> dict[str, int]:
    """Every alias and the number it means, sorted.

    Raises:
        RegistryError: a file is damaged.
    """
    found = sorted(entry.name for entry in directory.iterdir()) if directory.is_dir() else []
    numbers = {alias: read_alias(directory, alias) for alias in found if is_name(alias)}
    return {alias: number for alias, number in numbers.items() if number is not None}


def move_alias(directory: Path, alias: str, number: int, *, back: bool = True) -> None:
    """Make ``alias`` mean the version ``number``; any number of processes may do so at once.

    Without ``back``, an alias of a greater number stays: a slow publisher cannot undo a later one.

    Raises:
        RegistryError: a bad alias.
        StorageError: the disk cannot be written.
    """
    path = directory / check_alias(alias)
    with os_errors("write", path):
        directory.mkdir(parents=True, exist_ok=True)
        with open_to_append(directory / ".lock") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # closing the file frees it, and so does the process's death
            if back or (read_alias(directory, alias) or 0) < number:
                write_atomic(path, f"{number}\n".encode())
