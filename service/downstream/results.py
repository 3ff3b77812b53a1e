"""The table's directory: one JSON file per cell and run, written when the run has ended, never overwritten."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from service.downstream.directory import FORMAT_VERSION, read_json, write_json
from service.downstream.settings import CellConfig, differences
from service.errors import TandemError

Result = dict[str, Any]


class ResultsDirectory:
    """The results of cells, by their names."""

    def __init__(self, path: Path) -> None:
        """Nothing is read before it is asked for; the directory need not exist."""
        self.path = path

    def file(self, cell: CellConfig) -> Path:
        """Where the result of a cell is, or will be."""
        return self.path / f"{cell.name}.json"

    def find(self, cell: CellConfig, primitives: dict[str, str]) -> Result | None:
        """The result of a cell; None where it has not been run.

        Raises:
            TandemError: the file is damaged, of another format version, or of other settings or primitives.
        """
        path = self.file(cell)
        if not path.exists():
            return None
        result = _read(path)
        wanted = {"cell": cell.model_dump(mode="json"), "primitives": primitives}
        if wrong := differences({key: result.get(key) for key in wanted}, wanted):
            raise TandemError(f"{path} is of {'; '.join(wrong)}: give the same settings, or name another directory")
        return result

    def missing(self, cells: Iterable[CellConfig], primitives: dict[str, str]) -> list[CellConfig]:
        """The cells that have to be run; every file is checked before any is.

        Raises:
            TandemError: as for ``find``.
        """
        return [cell for cell in cells if self.find(cell, primitives) is None]

    def add(self, cell: CellConfig, result: Result) -> None:
        """Keep a result, in one step.

        Raises:
            TandemError: there is one already, or the disk is full.
        """
        path = self.file(cell)
        if path.exists():
            raise TandemError(f"{path} is there already; another process runs the same table")
        write_json(path, result)

    def read_all(self) -> list[Result]:
        """Every result there, by task, method and seed.

        Raises:
            TandemError: a file is damaged or of another format version.
        """
        return [_read(path) for path in sorted(self.path.glob("*.json"))]


def _read(path: Path) -> Result:
    result = read_json(path)
    found = result.get("format_version")
    if found != FORMAT_VERSION:
        raise TandemError(
            f"{path}: format version {found!r}, this program reads {FORMAT_VERSION}; name another directory"
        )
    return result
