"""The table of downstream trainings: a row per method, a column per task, success averaged over seeds.

Only runs that differ in nothing but their seed are averaged. A row has the same primitives and world in all columns, as
a table without them would compare methods that had different ones; its tasks may have had different settings, such as
env steps. Two settings on one task make two rows.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.downstream.files import RESULT_FILE
from service.errors import TandemError
from service.status.schemas import TaskCell, TaskColumn, TaskRow, TaskTable
from service.status.trial_details import resolved
from service.store.trial_reader import read_trial_result

Column = tuple[str, int]
"""A task and its version."""
_PLACE = ("task", "task_version", "method", "seed")
"""Settings that say where in the table a run belongs."""


@dataclass(frozen=True, slots=True)
class _Run:
    run_id: str
    method: str
    column: Column
    seed: int
    settings: dict[str, Any]
    """All that its result depends on but primitives, method, task and seed; flat, the world's too."""
    primitives: Mapping[str, Any]
    ended: float
    """Time of its result."""
    result: dict[str, Any] | None

    @property
    def made(self) -> tuple[str, str]:
        """Method and digest of the primitives."""
        return self.method, str(self.primitives.get("digest"))


def task_table(trials: Mapping[str, Path]) -> TaskTable:
    """Make the table of the downstream trainings in these directories, by the ids of their runs."""
    from service.downstream.methods import METHODS  # with MuJoCo and Gymnasium, which few views need
    from service.envs.tasks import HARD_TASKS, TASKS

    runs, problems = list[_Run](), list[str]()
    for run_id, path in trials.items():
        try:
            runs.append(_read(run_id, path))
        except TandemError as error:
            problems.append(str(error))
        except OSError as error:  # it may be deleted just now
            problems.append(f"{path} cannot be read: {error.strerror}")
    tasks = {**TASKS, **HARD_TASKS}
    columns = sorted({run.column for run in runs}, key=lambda column: (*_place(column[0], tasks), column[1]))
    rows = sorted(_rows(runs), key=lambda row: (*_place(_first(row).method, METHODS), str(_first(row).primitives)))
    differing = _differing(runs)
    return TaskTable(
        tasks=tuple(
            TaskColumn(task=task, version=version, title=tasks[task].title if task in tasks else task)
            for task, version in columns
        ),
        rows=tuple(
            TaskRow(
                method=_first(row).method,
                title=METHODS[_first(row).method].title if _first(row).method in METHODS else _first(row).method,
                primitives=_first(row).primitives.get("name"),
                primitives_digest=_first(row).primitives.get("digest"),
                cells=tuple(_cell(row[column], differing) for column in columns if column in row),
            )
            for row in rows
        ),
        problems=tuple(problems),
    )


def _read(run_id: str, path: Path) -> _Run:
    from service.downstream.results import settings_of

    (trial, primitives, world), result = resolved(path), read_trial_result(path)
    settings = {key: value for key, value in settings_of(trial).items() if key not in _PLACE}
    return _Run(
        run_id,
        trial.method,
        (trial.task, trial.task_version),
        trial.seed,
        _flat({**settings, "world": world}),
        primitives or {},
        (path / RESULT_FILE).stat().st_mtime if result is not None else 0.0,
        result,
    )


def _rows(runs: Sequence[_Run]) -> list[dict[Column, list[_Run]]]:
    """Rows by columns: those with most tasks first, and others beside them where they have none."""
    alike: dict[str, dict[Column, list[_Run]]] = {}
    for run in sorted(runs, key=lambda run: run.run_id):
        key = json.dumps([run.made, run.settings], sort_keys=True)
        alike.setdefault(key, {}).setdefault(run.column, []).append(run)
    rows: dict[str, list[dict[Column, list[_Run]]]] = {}
    for found in sorted(alike.values(), key=lambda each: -len(each)):
        world = {key: value for key, value in _first(found).settings.items() if key.startswith("world.")}
        same = rows.setdefault(json.dumps([_first(found).made, world], sort_keys=True), [])
        free = next((row for row in same if row.keys().isdisjoint(found)), None)
        if free is None:
            same.append(found)
        else:
            free.update(found)
    return [row for same in rows.values() for row in same]


def _cell(runs: Sequence[_Run], differing: Mapping[tuple[str, str], set[str]]) -> TaskCell:
    from service.downstream.rates import rate_of

    ended = sorted((run for run in runs if run.result is not None), key=lambda run: run.ended)
    counted = sorted({run.seed: run for run in ended}.values(), key=lambda run: run.seed)
    rate = rate_of([run.result for run in counted if run.result is not None]) if counted else None
    settings, keys = runs[0].settings, differing[runs[0].made]
    return TaskCell(
        task=runs[0].column[0],
        version=runs[0].column[1],
        success=rate.mean if rate else None,
        low=rate.low if rate else None,
        high=rate.high if rate else None,
        num_seeds=len(counted),
        run_ids=tuple(run.run_id for run in counted),
        unfinished=tuple(run.run_id for run in runs if run.result is None),
        differs={key: settings[key] for key in sorted(keys) if key in settings},
    )


def _differing(runs: Sequence[_Run]) -> dict[tuple[str, str], set[str]]:
    """Settings in which runs of one method with the same primitives differ."""
    found: dict[tuple[str, str], set[str]] = {}
    first: dict[tuple[str, str], dict[str, Any]] = {}
    for run in runs:
        one = first.setdefault(run.made, run.settings)
        keys = {key for key in one.keys() | run.settings.keys() if one.get(key) != run.settings.get(key)}
        found.setdefault(run.made, set()).update(keys)
    return found


def _first(row: Mapping[Column, Sequence[_Run]]) -> _Run:
    return next(iter(row.values()))[0]


def _flat(tree: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= _flat(value, f"{before}{key}.") if isinstance(value, dict) else {before + key: value}
    return found


def _place(name: str, known: Iterable[str]) -> tuple[int, str]:
    """Sorts as in the table that ``tandem downstream table`` prints; unknown names come after, by themselves."""
    order = list(known)
    return (order.index(name), "") if name in order else (len(order), name)
