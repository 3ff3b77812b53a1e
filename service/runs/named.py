"""What is to be trained, by its name: a recipe, a task, or a file."""

from __future__ import annotations

import json
from pathlib import Path

from service.base.errors import TandemError, did_you_mean
from service.base.user_code import parse_reference
from service.config.find import METHODS
from service.config.recipes import DEFAULT_RECIPE, recipes
from service.config.skills import SKILLS_OF
from service.config.task_methods import TASK_METHODS
from service.envs.tasks import TASKS


def targets() -> list[str]:
    """Names for ``tandem train NAME``; the shell completes them."""
    return [*recipes(), *TASKS]


def is_task(what: str) -> bool:
    """Whether it names a task, of ours or in a file of a user's."""
    return what in TASKS or parse_reference(what) is not None


def named(
    what: str | None, method: str | None, primitives: str | None, *, resumed: bool = False
) -> tuple[Path | None, list[str]]:
    """The file of a recipe or configuration, if any, and the overrides that a task or method stands for.

    Of a run that is ``resumed`` only what was said: it has its method.

    Raises:
        TandemError: no such recipe, task or file; or options that mean nothing there.
    """
    known = targets()
    if what is not None and is_task(what):
        if method is not None and method not in TASK_METHODS and parse_reference(method) is None:
            meant = did_you_mean(method, TASK_METHODS)
            raise TandemError(f"--method {method}: of a task choose one of {', '.join(TASK_METHODS)}{meant}")
        if method in TASK_METHODS and method not in METHODS:
            raise TandemError(f"{method} learns nothing: measure it by tandem evaluate --task {what} --method {method}")
        said = {"method": method or (None if resumed else "ours"), "primitives": primitives}
        chosen = {"task": what} | {key: word for key, word in said.items() if word is not None}
        # as JSON, which is YAML: a name may look like a number or a date
        return None, [f"{key}={json.dumps(word, ensure_ascii=False)}" for key, word in chosen.items()]
    if primitives is not None:
        raise TandemError("--primitives is for learning a task: name one, such as push; a run begins from --from")
    if what is None:
        # the default recipe is the one of self-play
        own = {"self-play": DEFAULT_RECIPE, **{name: f"{DEFAULT_RECIPE}-{name}" for name in SKILLS_OF}}
        recipe = recipes().get(own.get(method or "", ""))
        if recipe is None and method in TASK_METHODS:
            raise TandemError(f"--method {method} is for a task: name one, such as tandem train push")
        return recipe, [f"method={method}"] if method is not None and recipe is None else []
    if what not in known and not Path(what).suffix and not Path(what).exists():
        files = [str(file) for ending in (".py", ".yaml") if (file := Path(f"{what}{ending}")).is_file()]
        meant = f"; did you mean {' or '.join(files)}?" if files else did_you_mean(what, known)
        if f"{DEFAULT_RECIPE}-{what}" in known:
            meant = f"; did you mean {DEFAULT_RECIPE}-{what}?"
        elif what in TASK_METHODS:
            meant = f"; {what} is a method of tasks: tandem train push --method {what}"
        raise TandemError(f"{what!r}: no recipe, task or file of that name; there are {', '.join(known)}{meant}")
    if method is not None:
        raise TandemError(f"{what} says its method itself: leave out --method, or leave out {what}")
    return recipes().get(what, Path(what)), []
