"""The table's directory: one JSON file per cell and run, written when the run has ended, never overwritten."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from service.downstream.directory import FORMAT_VERSION, read_json, to_json
from service.downstream.methods import METHODS
from service.downstream.settings import CellConfig, differences, read_cell
from service.downstream.worker import Described
from service.errors import TandemError
from service.io.files import os_errors, write_exclusive

Result = dict[str, Any]


class ResultsDirectory:
    """The results of cells, by their names."""

    def __init__(self, path: Path) -> None:
        """Nothing is read before it is asked for; the directory need not exist."""
        self.path = path

    def file(self, cell: CellConfig) -> Path:
        """Where the result of a cell is, or will be."""
        return self.path / f"{cell.name}.json"

    def find(self, cell: CellConfig, described: Described) -> Result | None:
        """The result of a cell; None where it has not been run.

        Raises:
            TandemError: the file is damaged, of another format version, or of other settings or primitives.
        """
        path = self.file(cell)
        if not path.exists():
            return None
        result = _read(path)
        wanted = {"cell": _settings(cell), **described.of(cell.method)}
        if wrong := differences({"cell": _settings(read_cell(result, path)), **_made_with(result)}, wanted):
            raise TandemError(f"{path} is of {'; '.join(wrong)}: give the same settings, or name another directory")
        return result

    def missing(self, cells: Iterable[CellConfig], described: Described) -> list[CellConfig]:
        """The cells that have to be run; every file is checked before any is.

        What is in the directory and what is asked for comes onto one page: of the same world, of the same primitives
        where a method takes any, and the seeds of a method on a task with the same settings.

        Raises:
            TandemError: as for ``find``; or the page would mix what cannot be compared.
        """
        missing = [cell for cell in cells if self.find(cell, described) is None]
        of_all_seeds = {(cell.method, cell.task): (f"{cell.name}, asked for,", _settings(cell)) for cell in missing}
        for path in self._files():
            result = _read(path)
            cell = read_cell(result, path)
            if wrong := differences(_made_with(result), described.of(cell.method)):
                raise TandemError(f"{path} is of {'; '.join(wrong)}: name another directory, or move it away")
            other, settings = of_all_seeds.setdefault((cell.method, cell.task), (str(path), _settings(cell)))
            if wrong := differences(_settings(cell) | {"seed": 0}, settings | {"seed": 0}):
                raise TandemError(f"{path} and {other} are seeds of one method, but of {'; '.join(wrong)}")
        return missing

    def add(self, cell: CellConfig, result: Result) -> None:
        """Keep a result, in one step.

        Raises:
            TandemError: there is one already, or the disk is full.
        """
        path = self.file(cell)
        with os_errors("write", path):
            path.parent.mkdir(parents=True, exist_ok=True)
            kept = write_exclusive(path, to_json(result))
        if not kept:
            raise TandemError(f"{path} is there already; another process runs the same table")

    def read_all(self) -> list[Result]:
        """Every result there, by task, method and seed.

        Raises:
            TandemError: a file is damaged or of another format version.
        """
        return [_read(path) for path in self._files()]

    def _files(self) -> list[Path]:
        return sorted(self.path.glob("*.json"))


def _made_with(result: Result) -> dict[str, Any]:
    return {key: result.get(key) for key in ("primitives", "world")}


def _settings(cell: CellConfig) -> dict[str, Any]:
    """What a cell's result depends on: where nothing is learned, not on how."""
    method = METHODS.get(cell.method)
    learning = {"sac", "num_env_steps", "curve_every", "curve_episodes"}
    return cell.model_dump(mode="json", exclude=learning if method and method.player else None)


def _read(path: Path) -> Result:
    result = read_json(path)
    found = result.get("format_version")
    if found != FORMAT_VERSION:
        raise TandemError(
            f"{path}: format version {found!r}, this program reads {FORMAT_VERSION}; name another directory"
        )
    return result
