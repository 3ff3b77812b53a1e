"""The tasks that come with Tandem, a file each, as a user's own would be; and finding a task by name or file.

The paper's six come first, in its order. The harder ones have a start and a cube in which chance seldom finds the
object. Reasons for the numbers: docs/decisions/0007.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from service.base.errors import TandemError, did_you_mean
from service.base.user_code import parse_reference, recorded
from service.envs.task import Task, task_in

PAPERS = ("larger", "inair", "push", "sphere", "wall", "box")
_HARD = "hard-"
_HARDER = {"start_height_m": 0.20, "object_mass_kg": 1.0, "friction": 0.25, "pad_friction": 0.5}
"""Start and cube of panda-gym 3.0.7, but for the cube's edge, 4 cm there. Its simulator multiplies two frictions: 0.5
of the cube by 0.5 of the table, and by 1 of the fingers. MuJoCo takes the greater one."""
TASKS = (*PAPERS, "hard-larger", "hard-inair", "hard-push", "hard-box")
"""Names of the tasks that come with Tandem. A hand-written policy fails in most episodes of a harder Sphere and Wall,
so their difficulty is not known, and they are left out."""


def find_task(name: str | Path, code: Mapping[str, str] | None = None, world: Mapping[str, Any] | None = None) -> Task:
    """Find a task by its name, or in a file of a user's.

    Args:
        name: one of ``TASKS``; or ``FILE.py``, ``FILE.py:NAME`` or ``MODULE:NAME``.
        code: texts that a run has recorded, by the names of their files; other files are read.
        world: settings of the world of a user's task, as a run has recorded them; None: those in the file.

    Raises:
        TandemError: no such task, or a file that has none.
    """
    name = str(name)
    if name in TASKS:
        return _our_task(name)
    if parse_reference(name) is None:
        raise TandemError(
            f"unknown task {name!r}; choose one of {', '.join(TASKS)}, or write FILE.py:NAME{did_you_mean(name, TASKS)}"
        )
    task = task_in(name, recorded(name, code or {}))
    return task if world is None else replace(task, world=world)


@cache
def _our_task(name: str) -> Task:
    task: Task = import_module(f"{__name__}.{name.removeprefix(_HARD)}").TASK
    if name.startswith(_HARD):
        about = f"{task.description}; a higher start, a heavy and slippery cube"
        task = replace(task, title=f"Hard{task.title}", description=about, world={**task.world, **_HARDER})
    return replace(task, name=name)
