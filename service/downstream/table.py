"""The table: runs the trials that are missing, one after another here or many at once on Ray.

Consumes the results directory; produces a file there for each trial as it ends. A trial that was cut off continues from
its own training directory, which lies where it ran.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.downstream.files import Result, made_with
from service.downstream.methods import METHODS, find_method, load_for, provenance
from service.downstream.rates import by_method_and_task, rate_of
from service.downstream.results import ResultsDirectory
from service.downstream.settings import TrialConfig
from service.downstream.worker import Callbacks, RunOptions, check_trial, run_trial
from service.envs.tasks import HARD_TASKS, TASKS
from service.errors import TandemError
from service.primitives.loading import Trained
from service.progress import doing
from service.registry.names import is_service

_POLL_S = 1.0


@dataclass(frozen=True, slots=True)
class Source:
    """Places where a worker, on whatever machine, takes primitives from and trains."""

    primitives: str
    registry: str
    """A directory, or the URL of a status service."""
    runs: Path
    """Training directories are made here."""


Results = Iterator[tuple[TrialConfig, Result]]
Runner = Callable[[Sequence[TrialConfig], Trained, Source, Callbacks], Results]
"""Runs trials with these primitives, which are the source's; ends early where it is to stop."""


def make_table(trials: Sequence[TrialConfig], source: Source, out: Path, runner: Runner, callbacks: Callbacks) -> bool:
    """Run what is missing, each result into a file of its own in ``out/downstream``.

    Returns:
        Whether everything is there; False where it was stopped before.

    Raises:
        TandemError: results that are damaged, of another version or other settings, primitives that do not fit or
            cannot be fetched, or a trial that failed. What had ended is kept.
    """
    trained = load_for({trial.method for trial in trials}, source.primitives, source.registry)
    results = ResultsDirectory(out / "downstream")
    missing = results.missing(trials, trained)
    callbacks.say(f"{len(trials) - len(missing)} of {len(trials)} trials are there, {len(missing)} to run")
    done = 0
    with doing("trials", len(missing), "trials") as task:
        for trial, result in runner(missing, trained, source, callbacks):
            if made_with(result) != provenance(trained, trial.method):
                raise TandemError(f"{source.primitives} has changed in {source.registry} meanwhile; give NAME@VERSION")
            results.add(trial, result)
            done += 1
            task.advance()
            rate = result["evaluation"]["success_last"]
            callbacks.say(f"{trial.name}: {rate:.1%} at the last step ({done} of {len(missing)})")
    return done == len(missing)


def success_table(out: Path) -> list[Sequence[str]]:
    """A head with the tasks, and for each method its success at the last step, of every result in the directory.

    Raises:
        TandemError: a result is damaged or of another version.
    """
    of = by_method_and_task(ResultsDirectory(out / "downstream").read_all())
    tasks = [task for task in (*TASKS, *HARD_TASKS) if any(task == other for _, other in of)]
    methods = [method for method in METHODS if any(method == other for other, _ in of)]
    seeds = [[of.get((method, task)) for task in tasks] for method in methods]
    rows = [[str(rate_of(each)) if each else "" for each in row] for row in seeds]
    return [("method", *tasks), *((method, *row) for method, row in zip(methods, rows, strict=True))]


def run_here(
    trials: Sequence[TrialConfig], trained: Trained, source: Source, callbacks: Callbacks, *, num_threads: int = 0
) -> Results:
    """Run one trial after another in this process."""
    for trial in trials:  # before hours of work
        check_trial(trial, trained, source.runs / trial.name)
    options = RunOptions(resume=True, num_threads=num_threads, callbacks=callbacks)
    for trial in trials:
        if callbacks.stop():
            return
        callbacks.say(f"{trial.name} ...")
        result = run_trial(trial, trained, source.runs / trial.name, options)
        if result is None:
            return
        yield trial, result


def run_on_ray(
    trials: Sequence[TrialConfig],
    trained: Trained,
    source: Source,
    callbacks: Callbacks,
    *,
    num_workers: int | None = None,
    num_threads: int = 1,
) -> Results:
    """Give trials to tasks on the connected cluster.

    Waits for whichever task ends first; told to stop, it ends them at once, and each loses what came after its last
    checkpoint. A task that a machine took with it is tried again, and continues from its training directory where the
    new place has it. Tasks fetch primitives from a service themselves; a directory is read here, and what was in it
    sent along: another machine has another one.

    Args:
        trials: what to run.
        trained: the source's primitives.
        source: where tasks take them from and train.
        callbacks: told which trial begins, and asked when to stop; iterations are not told.
        num_workers: tasks at once, at most; None: as many as there are cores for.
        num_threads: cores of each.
    """
    import ray

    limit = num_workers or max(int(ray.cluster_resources().get("CPU", 1)) // num_threads, 1)
    task = ray.remote(num_cpus=num_threads, max_retries=3)(_run_remotely)
    for trial in trials:
        find_method(trial.method).check(trained)
    primitives: Any = source if is_service(source.registry) else ray.put(trained)
    waiting, running = iter(trials), dict[Any, TrialConfig]()
    while True:
        for trial in itertools.islice(waiting, limit - len(running)):
            callbacks.say(f"{trial.name} ...")
            running[task.remote(trial, primitives, source.runs / trial.name, num_threads)] = trial
        if not running or callbacks.stop():
            for reference in running:
                ray.cancel(reference, force=False)
            return
        ended, _ = ray.wait(list(running), num_returns=1, timeout=_POLL_S)
        for reference in ended:
            trial = running.pop(reference)
            yield trial, _fetch(trial, reference)


def _run_remotely(trial: TrialConfig, primitives: Source | Trained, path: Path, num_threads: int) -> Result:
    """Run a trial in a Ray task, wherever it is."""
    if isinstance(primitives, Source):
        primitives = load_for([trial.method], primitives.primitives, primitives.registry)
    result = run_trial(trial, primitives, path, RunOptions(resume=True, num_threads=num_threads))
    assert result is not None, "nobody asks a task to stop"
    return result


def _fetch(trial: TrialConfig, reference: Any) -> Result:
    import ray

    try:
        result: Result = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, TandemError):
            raise error.cause from None
        raise
    except ray.exceptions.RayError as error:  # the process was killed, out of memory, or its machine went, every time
        why = str(error).strip().splitlines()[0]
        raise TandemError(f"{trial.name}: its task died ({why}); the same command continues") from None
    return result
