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
from service.downstream.methods import find_method
from service.downstream.page import MARK, write_page
from service.downstream.pictures import draw_table
from service.downstream.results import Result, ResultsDirectory
from service.downstream.settings import CellConfig
from service.downstream.worker import Running, check_cell, describe, run_cell
from service.errors import TandemError
from service.io.files import os_errors, write_atomic

if TYPE_CHECKING:
    from service.primitives.loading import TrainedBob

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
    _check_page(out / PAGE_FILE)
    trained = source.load()
    results, described = ResultsDirectory(out / RESULTS), describe(trained)
    missing = results.missing(cells, described)
    watching.say(f"{len(cells) - len(missing)} of {len(cells)} cells are there, {len(missing)} to run")
    done = 0
    for cell, result in runner(missing, trained, source, watching):
        if any(result[key] != value for key, value in described.of(cell.method).items()):
            raise TandemError(f"{source.primitives} has changed in {source.registry} meanwhile; give NAME@VERSION")
        results.add(cell, result)
        done += 1
        rate = result["evaluation"]["success_last"]
        watching.say(f"{cell.name}: {rate:.1%} at the last step ({done} of {len(missing)})")
    for path in write_results(out):
        watching.say(str(path))
    return done == len(missing)


def _check_page(path: Path) -> None:
    """Refuse to replace what a person wrote."""
    with os_errors("read", path):
        ours = not path.exists() or MARK in path.read_text(encoding="utf-8")
    if not ours:
        raise TandemError(f"{path} was not written by this command; name another directory with --out")


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


Runner = Callable[[Sequence[CellConfig], "TrainedBob", Source, Watching], Iterator[tuple[CellConfig, Result]]]
"""Runs cells with these primitives, which are the source's."""


def run_here(num_threads: int = 0) -> Runner:
    """A runner that takes one cell after another in this process."""

    def run(
        cells: Sequence[CellConfig], trained: TrainedBob, source: Source, watching: Watching
    ) -> Iterator[tuple[CellConfig, Result]]:
        for cell in cells:  # before hours of work
            check_cell(cell, trained, source.runs / cell.name)
        for cell in cells:
            if watching.stop():
                return
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

    Waits for whichever task ends first; told to stop, it ends them at once, and each loses what came after its last
    checkpoint. A task that a machine took with it is tried again, and continues from its training directory where the
    new place has it. Tasks fetch primitives from a service themselves; a directory is read here, and what was in it
    sent along: another machine has another one.

    Args:
        num_workers: tasks at once, at most; None: as many as there are cores for.
        num_threads: cores of each.
    """

    def run(
        cells: Sequence[CellConfig], trained: TrainedBob, source: Source, watching: Watching
    ) -> Iterator[tuple[CellConfig, Result]]:
        import ray

        limit = num_workers or max(int(ray.cluster_resources().get("CPU", 1)) // num_threads, 1)
        task = ray.remote(num_cpus=num_threads, max_retries=3)(_run_remotely)
        for cell in cells:
            find_method(cell.method).check(trained)
        primitives: Any = source if service.is_service(source.registry) else ray.put(trained)
        waiting, running = iter(cells), dict[Any, CellConfig]()
        while True:
            for cell in itertools.islice(waiting, limit - len(running)):
                watching.say(f"{cell.name} ...")
                running[task.remote(cell, primitives, source.runs / cell.name, num_threads)] = cell
            if not running or watching.stop():
                for reference in running:
                    ray.cancel(reference, force=False)
                return
            ended, _ = ray.wait(list(running), num_returns=1, timeout=_POLL_S)
            for reference in ended:
                cell = running.pop(reference)
                yield cell, _fetch(cell, reference)

    return run


def _run_remotely(cell: CellConfig, primitives: Source | TrainedBob, path: Path, num_threads: int) -> Result:
    """What a Ray task does, wherever it is."""
    trained = primitives.load() if isinstance(primitives, Source) else primitives
    result = run_cell(cell, trained, path, Running(resume=True, num_threads=num_threads))
    assert result is not None, "nobody asks a task to stop"
    return result


def _fetch(cell: CellConfig, reference: Any) -> Result:
    import ray

    try:
        result: Result = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, TandemError):
            raise error.cause from None
        raise
    except ray.exceptions.RayError as error:  # the process was killed, out of memory, or its machine went, every time
        why = str(error).strip().splitlines()[0]
        raise TandemError(f"{cell.name}: its task died ({why}); the same command continues") from None
    return result
