"""The table of downstream trainings: a row per method, a column per task, success averaged over seeds.

Only runs that differ in nothing but their seed are averaged. A row has the same primitives and world in all columns, as
a table without them would compare methods that had different ones; its tasks may have had different settings, such as
env steps. Two settings on one task make two rows, and so do two versions of what learns.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from zlib import crc32

from service.base.errors import TandemError
from service.base.intervals import rate_of
from service.base.parsing import parse_json
from service.base.version import LEARNING_VERSION
from service.config.task_methods import TASK_METHODS
from service.config.tree import leaves, read_yaml
from service.status.schemas import TaskCell, TaskColumn, TaskRow, TaskTable
from service.store.models import CONFIG_FILE, RunStatus, Trial
from service.store.run_directory import RESULT_FILE, RunDirectory

Column = tuple[str, int]
"""A task and its version."""
_ELSEWHERE = {"name", "primitives", "primitives_digest", "task", "task_version", "episode_steps", "method", "seed"}
"""Keys of a configuration that say where in the table a run belongs."""


@dataclass(frozen=True, slots=True)
class _Run:
    run_id: str
    trial: Trial
    column: Column
    settings: dict[str, Any]
    """Whatever its result depends on but primitives, method, task and seed; flat, the world's too."""
    ended: float
    """Time of its result."""
    result: dict[str, Any] | None

    @property
    def made(self) -> tuple[str, str | None]:
        """Method and digest of the primitives."""
        return self.trial.method, self.trial.primitives_digest


def task_table(statuses: Iterable[RunStatus], directories: Mapping[str, Path]) -> TaskTable:
    """Make the table of those runs that learn a task and are on this machine.

    Args:
        statuses: of all runs.
        directories: of the runs that are on this machine, by their ids.
    """
    from service.envs.tasks import TASKS, find_task

    runs, problems = list[_Run](), list[str]()
    for status in statuses:
        path = directories.get(status.run_id)
        try:
            if path is not None and status.trial is not None:
                runs.append(_read(status, status.trial, path))
        except FileNotFoundError:  # it has only begun, or is deleted just now
            continue
        except OSError as error:
            problems.append(f"{path} cannot be read: {error.strerror}")
        except TandemError as error:
            problems.append(str(error))
    columns = sorted({run.column for run in runs}, key=lambda column: (*_place(column[0], TASKS), column[1]))
    values = _values(runs)
    rows = [(_first(row).trial, row) for row in _rows(runs)]
    rows.sort(key=lambda row: (*_place(row[0].method, TASK_METHODS), str(row[0].primitives)))
    return TaskTable(
        tasks=tuple(
            TaskColumn(task=task, version=version, title=find_task(task).title if task in TASKS else task)
            for task, version in columns
        ),
        rows=tuple(
            TaskRow(
                method=trial.method,
                title=TASK_METHODS[trial.method].title if trial.method in TASK_METHODS else trial.method,
                primitives=trial.primitives,
                primitives_digest=trial.primitives_digest,
                cells=tuple(_cell(row[column], values[_first(row).made]) for column in columns if column in row),
            )
            for trial, row in rows
        ),
        problems=tuple(problems),
    )


def _read(status: RunStatus, trial: Trial, path: Path) -> _Run:
    """A run that learns a task. Its configuration is taken as data: no method of a user's own is imported."""
    config = path / CONFIG_FILE
    settings = _settings(config, config.stat().st_mtime_ns)
    result = RunDirectory(path).read_result()
    if result is not None:
        # or else it may be of a shorter training, which goes on
        is_last = status.state in ("finished", "converged") or result["env_steps"] >= status.total_env_steps
        if not is_last or not {"success_last", "num_episodes"} <= result["evaluation"].keys():
            result = None
    ended = (path / RESULT_FILE).stat().st_mtime if result is not None else 0.0
    made = {} if result is None else result.get("made")
    made = made if isinstance(made, dict) else {}
    version = settings.get("task_version")
    column = (trial.task, version if isinstance(version, int) else 0)
    counted = {  # of a text of a user's its digest tells another
        key: crc32(str(value).encode()) if key.startswith("code.") else value
        for key, value in settings.items()
        if _counts(key)
    }
    counted["learning_version"] = LEARNING_VERSION if result is None else made.get("learning_version", 1)
    return _Run(status.run_id, trial, column, counted, ended, result)


def _counts(key: str) -> bool:
    """Whether a result depends on a key of the configuration, and the place in the table does not say it."""
    return key == "run.total_env_steps" or not (key in _ELSEWHERE or key.startswith("run."))


@lru_cache(100_000)
def _settings(config: Path, _stamp: int) -> dict[str, Any]:
    """A run's configuration, flat; the page asks every few seconds, and YAML is slow."""
    text = json.dumps(read_yaml(config), default=str, skipkeys=True)  # YAML has dates, and keys that are no text
    return dict(leaves(parse_json(text, config)))


def _rows(runs: Sequence[_Run]) -> list[dict[Column, list[_Run]]]:
    """Rows by columns: those with most tasks first, and others beside them where they have none."""
    alike: dict[str, dict[Column, list[_Run]]] = {}
    for run in sorted(runs, key=lambda run: run.run_id):
        key = json.dumps([run.made, run.settings], sort_keys=True)
        alike.setdefault(key, {}).setdefault(run.column, []).append(run)
    rows: dict[str, list[dict[Column, list[_Run]]]] = {}
    for found in sorted(alike.values(), key=lambda each: -len(each)):
        settings = _first(found).settings.items()
        world = {key: value for key, value in settings if key.startswith("world.") or key == "learning_version"}
        same = rows.setdefault(json.dumps([_first(found).made, world], sort_keys=True), [])
        free = next((row for row in same if row.keys().isdisjoint(found)), None)
        if free is None:
            same.append(found)
        else:
            free.update(found)
    return [row for same in rows.values() for row in same]


def _cell(runs: Sequence[_Run], values: Mapping[str, set[str]]) -> TaskCell:
    ended = sorted((run for run in runs if run.result is not None), key=lambda run: run.ended)
    by_seed = {run.trial.seed: run for run in ended}
    counted = [by_seed[seed] for seed in sorted(by_seed)]
    rate = rate_of([run.result for run in counted if run.result is not None]) if counted else None
    task, version = runs[0].column
    return TaskCell(
        task=task,
        version=version,
        success=rate.mean if rate else None,
        low=rate.low if rate else None,
        high=rate.high if rate else None,
        num_seeds=len(counted),
        run_ids=tuple(run.run_id for run in counted),
        unfinished=tuple(run.run_id for run in runs if run.result is None),
        differs={key: value for key, value in sorted(runs[0].settings.items()) if len(values[key]) > 1},
    )


def _values(runs: Sequence[_Run]) -> dict[tuple[str, str | None], dict[str, set[str]]]:
    """All values of each setting, as text, by method and primitives; of a run that lacks one it is None."""
    found: dict[tuple[str, str | None], dict[str, set[str]]] = {}
    for made in {run.made for run in runs}:
        settings = [run.settings for run in runs if run.made == made]
        keys = {key for each in settings for key in each}
        found[made] = {key: {repr(each.get(key)) for each in settings} for key in keys}
    return found


def _first(row: Mapping[Column, Sequence[_Run]]) -> _Run:
    return next(iter(row.values()))[0]


def _place(name: str, known: Iterable[str]) -> tuple[int, str]:
    """Key that sorts names as they are listed; unknown names come after them, alphabetically."""
    return [*known, name].index(name), name
