"""``tandem configs``: the configurations that come with tandem."""

from __future__ import annotations

from typing import Annotated

import typer

from service.cli.common import CommandGroup, JsonOption, print_json, print_table
from service.errors import TandemError, did_you_mean
from service.recipes import first_comment, recipes, robots

configs_app = typer.Typer(name="configs", help="Recipes and robots that come with tandem.", cls=CommandGroup)


def config_names() -> list[str]:
    """Names for ``--config``; the shell completes them."""
    return list(recipes())


@configs_app.callback(invoke_without_command=True)
def list_configs(context: typer.Context, as_json: JsonOption = False) -> None:
    """List recipes, for tandem pretrain --config NAME, and robots, for --set world.robot=NAME."""
    if context.invoked_subcommand is not None:
        return
    rows = [
        {"name": name, "kind": kind, "about": first_comment(path)}
        for kind, known in (("recipe", recipes()), ("robot", robots()))
        for name, path in known.items()
    ]
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
