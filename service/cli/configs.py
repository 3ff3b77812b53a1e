"""``tandem configs``, ``tandem methods`` and ``tandem tasks``: what can be named, with a line each."""

from __future__ import annotations

from typing import Annotated

import typer

from service.base.errors import TandemError, did_you_mean
from service.cli.common import CommandGroup, JsonOption, print_json, print_table
from service.config.find import METHODS, find_class
from service.config.recipes import first_comment, recipes, robots
from service.config.task_methods import TASK_METHODS
from service.envs.tasks import TASKS, find_task

configs_app = typer.Typer(name="configs", help="Recipes and robots that come with tandem.", cls=CommandGroup)


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
