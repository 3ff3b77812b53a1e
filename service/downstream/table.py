"""The table: runs the cells that are missing, one after another here or many at once on Ray, and writes the page.

Consumes the results directory; produces a file there for each cell as it ends, then page and picture. A cell that was
cut off continues from its own training directory, which lies where it ran.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import service
from service.downstream.page import write_page
from service.downstream.pictures import draw_table
from service.downstream.results import Result, ResultsDirectory
from service.downstream.settings import CellConfig
from service.downstream.worker import Running, describe_primitives, run_cell
from service.errors import TandemError
from service.registry.files import os_errors, write_atomic

if TYPE_CHECKING:
    from service.runtime.primitives import TrainedBob

PAGE_FILE, PICTURE_FILE, RESULTS = "downstream.md", "downstream.png", "downstream"
_POLL_S = 1.0


@dataclass(frozen=True, slots=True)
class Source:
    """Where a worker, on whatever machine, takes primitives from and trains."""

    primitives: str
    registry: str
    """A directory, or the URL of a status service."""
    runs: Path
    """Training directories are made here."""

    def load(self) -> TrainedBob:
        """The primitives.

        Raises:
            TandemError: as of ``service.load_primitives``.
        """
        return service.load_primitives(self.primitives, self.registry)


@dataclass(frozen=True, slots=True)
class Watching:
    """What the caller wants to know, and when to stop."""

    stop: Callable[[], bool] = lambda: False
    on_iteration: Callable[[dict[str, float]], None] = lambda metrics: None
    say: Callable[[str], None] = lambda text: None
    signal: Callable[[], int] = lambda: 0
    """Number of the signal that stops."""


def make_table(cells: Sequence[CellConfig], source: Source, out: Path, runner: Runner, watching: Watching) -> bool:
    """Run what is missing and write the page.

    Returns:
        Whether everything is there; False where it was stopped before.

    Raises:
        TandemError: results of another version or other settings, primitives that do not fit or cannot be fetched, or a
            cell that failed. What had ended is kept.
    """
    results, primitives = ResultsDirectory(out / RESULTS), describe_primitives(source.load())
    missing = results.missing(cells, primitives)
    results.read_all()  # what the page cannot take in is found before hours of work
    watching.say(f"{len(cells) - len(missing)} of {len(cells)} cells are there, {len(missing)} to run")
    done = 0
    for cell, result in runner(missing, source, watching):
        if result["primitives"] != primitives:
            raise TandemError(f"{source.primitives} has changed in {source.registry} meanwhile; give NAME@VERSION")
        results.add(cell, result)
        done += 1
        rate = result["evaluation"]["success_last"]
        watching.say(f"{cell.name}: {rate:.1%} at the last step ({done} of {len(missing)})")
    for path in write_results(out):
        watching.say(str(path))
    return done == len(missing)


def write_results(out: Path) -> list[Path]:
    """Page and picture from every result in the directory.

    Raises:
        TandemError: a result is damaged or of another version, or something cannot be written.
    """
    found = ResultsDirectory(out / RESULTS).read_all()
    picture, page = draw_table(found, out / PICTURE_FILE), out / PAGE_FILE
    with os_errors("write", page):
        write_atomic(page, write_page(found, PICTURE_FILE).encode())
    return [page, picture]


Runner = Callable[[Sequence[CellConfig], Source, Watching], Iterator[tuple[CellConfig, Result]]]


def run_here(num_threads: int = 0) -> Runner:
    """A runner that takes one cell after another in this process."""

    def run(cells: Sequence[CellConfig], source: Source, watching: Watching) -> Iterator[tuple[CellConfig, Result]]:
        trained = source.load()
        for cell in cells:
            watching.say(f"{cell.name} ...")
            running = Running(
                resume=True, num_threads=num_threads, stop=watching.stop, on_iteration=watching.on_iteration
            )
            result = run_cell(cell, trained, source.runs / cell.name, running)
            if result is None:
                return
            yield cell, result

    return run


def run_on_ray(num_workers: int | None, num_threads: int = 1) -> Runner:
    """A runner that gives cells to tasks on the connected cluster.

    Waits for whichever task ends first; told to stop, it lets tasks save and end. A task that a machine took with it is
    tried again, and continues from its training directory where the new place has it.

    Args:
        num_workers: tasks at once, at most; None: as many as there are cores for.
        num_threads: cores of each.
    """

    def run(cells: Sequence[CellConfig], source: Source, watching: Watching) -> Iterator[tuple[CellConfig, Result]]:
        import ray

        limit = num_workers or max(int(ray.cluster_resources().get("CPU", 1)) // num_threads, 1)
        task = ray.remote(num_cpus=num_threads, max_retries=3)(_run_remotely)
        waiting, running = iter(cells), dict[Any, CellConfig]()
        while True:
            for cell in itertools.islice(waiting, limit - len(running)):
                watching.say(f"{cell.name} ...")
                running[task.remote(cell, source, num_threads)] = cell
            if not running or watching.stop():
                for reference in running:
                    ray.cancel(reference, force=False)
                return
            ended, _ = ray.wait(list(running), num_returns=1, timeout=_POLL_S)
            for reference in ended:
                yield running.pop(reference), _fetch(reference)

    return run


def _run_remotely(cell: CellConfig, source: Source, num_threads: int) -> Result:
    """What a Ray task does, wherever it is."""
    result = run_cell(cell, source.load(), source.runs / cell.name, Running(resume=True, num_threads=num_threads))
    assert result is not None, "nobody asks a task to stop"
    return result


def _fetch(reference: Any) -> Result:
    import ray

    try:
        result: Result = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, TandemError):
            raise error.cause from None
        raise
    return result
