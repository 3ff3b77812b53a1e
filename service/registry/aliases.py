"""Movable aliases of one name: files that each hold the number of a version."""

from __future__ import annotations

import fcntl
from pathlib import Path

from service.io.files import os_errors, write_atomic
from service.registry.errors import RegistryError
from service.registry.names import check_alias, is_name, is_number


class Aliases:
    """The aliases of one name in a directory; any number of processes may move them at once."""

    def __init__(self, directory: Path) -> None:
        """Take the directory; nothing is written before the first `move`."""
        self._directory = directory

    def read(self, alias: str) -> int | None:
        """The number ``alias`` means; None when there is no such alias.

        Raises:
            RegistryError: a bad alias, or its file is damaged.
            StorageError: the file cannot be read.
        """
        path = self._directory / check_alias(alias)
        with os_errors("read", path):
            try:
                text = path.read_bytes().decode("ascii", errors="replace").strip()
            except FileNotFoundError:
                return None
        if not is_number(text):
            raise RegistryError(f"alias {path} is damaged: it holds {text!r}; set it again with tandem registry alias")
        return int(text)

    def read_all(self) -> dict[str, int]:
        """Every alias and the number it means, sorted.

        Raises:
            RegistryError: a file is damaged.
        """
        found = sorted(entry.name for entry in self._directory.iterdir()) if self._directory.is_dir() else []
        numbers = {alias: self.read(alias) for alias in found if is_name(alias)}
        return {alias: number for alias, number in numbers.items() if number is not None}

    def move(self, alias: str, number: int, *, back: bool = True) -> None:
        """Make ``alias`` mean ``number``.

        Args:
            alias: to move.
            number: of the version.
            back: also where it means a greater one; without, a slow publisher cannot undo a later one.

        Raises:
            RegistryError: a bad alias.
            StorageError: the disk cannot be written.
        """
        path = self._directory / check_alias(alias)
        with os_errors("write", path):
            self._directory.mkdir(parents=True, exist_ok=True)
            with (self._directory / ".lock").open("a") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)  # closing the file frees it, and so does the process's death
                if back or (self.read(alias) or 0) < number:
                    write_atomic(path, f"{number}\n".encode())
