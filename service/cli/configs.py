"""``tandem configs``, ``tandem methods`` and ``tandem tasks``: what can be named, with a line each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from service.base.errors import TandemError, did_you_mean
from service.base.user_code import parse_reference
from service.cli.common import CommandGroup, JsonOption, print_json, print_table
from service.config.find import METHODS, find_class
from service.config.recipes import DEFAULT_RECIPE, first_comment, recipes, robots
from service.config.task_methods import TASK_METHODS
from service.envs.tasks import TASKS, find_task

configs_app = typer.Typer(name="configs", help="Recipes and robots that come with tandem.", cls=CommandGroup)


def targets() -> list[str]:
    """Names for ``tandem train NAME``; the shell completes them."""
    return [*recipes(), *TASKS]


def is_task(what: str) -> bool:
    """Whether it names a task, of ours or in a file of a user's."""
    return what in TASKS or parse_reference(what) is not None


def named(what: str | None, method: str | None, primitives: str | None) -> tuple[Path | None, list[str]]:
    """The file of a recipe or configuration, if any, and the overrides that a task or method stands for.

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
        chosen = {"task": what, "method": method or "ours"} | ({} if primitives is None else {"primitives": primitives})
        # as JSON, which is YAML: a name may look like a number or a date
        return None, [f"{key}={json.dumps(word, ensure_ascii=False)}" for key, word in chosen.items()]
    if primitives is not None:
        raise TandemError("--primitives is for learning a task: name one, such as push; a run begins from --from")
    if what is None:
        # the default recipe is the one of self-play
        recipe = recipes().get(DEFAULT_RECIPE if method == "self-play" else f"{DEFAULT_RECIPE}-{method}")
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


@configs_app.callback(invoke_without_command=True)
def list_configs(context: typer.Context, as_json: JsonOption = False) -> None:
    """List recipes, for tandem train NAME, and robots, for --set world.robot=NAME."""
    if context.invoked_subcommand is not None:
        return
    rows = [
        {"name": name, "kind": kind, "about": first_comment(path)}
        for kind, known in (("recipe", recipes()), ("robot", robots()))
        for name, path in known.items()
    ]
    _show(rows, as_json)


def methods(as_json: JsonOption = False) -> None:
    """List the methods by which a run learns, and those of tandem evaluate, which learn nothing."""
    rows = []
    for name in [*METHODS, *(each for each in TASK_METHODS if each not in METHODS)]:
        if name in TASK_METHODS:
            what = "a task" if name in METHODS else "nothing"
            rows.append({"name": name, "learns": what, "about": TASK_METHODS[name].description})
        else:
            about = (find_class(name, {}).__doc__ or "").partition("\n")[0]
            rows.append({"name": name, "learns": "pre-training", "about": about.rstrip(".")})
    _show(rows, as_json)


def tasks(as_json: JsonOption = False) -> None:
    """List the tasks, for tandem train TASK, and for --task of the commands that know tasks."""
    known = map(find_task, TASKS)
    _show([{"name": task.name, "title": task.title, "about": task.description} for task in known], as_json)


def _show(rows: list[dict[str, str]], as_json: bool) -> None:
    if as_json:
        print_json(rows)
    else:
        print_table(list(rows[0]), [list(row.values()) for row in rows])


@configs_app.command()
def show(
    name: Annotated[str, typer.Argument(autocompletion=lambda: [*recipes(), *robots()], help="Of a recipe or robot.")],
) -> None:
    """Print a recipe or a robot's description, to be changed and used as a file."""
    known = {**robots(), **recipes()}
    if name not in known:
        raise TandemError(f"no configuration {name!r}; there are: {', '.join(known)}{did_you_mean(name, known)}")
    typer.echo(known[name].read_text(encoding="utf-8"), nl=False)
