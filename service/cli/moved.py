"""``tandem downstream``, which was a group of commands until version 0.2: it names the command of today."""

from __future__ import annotations

from typing import Annotated

import typer

from service.base.errors import TandemError

_NOW = {
    "train": "tandem train TASK --method NAME --primitives X --set seed=N --set run.total_env_steps=N",
    "table": "tandem train push,wall --method ours,ours-her --seeds 0-2",
    "evaluate": "tandem evaluate X --task NAME",
    "render": "tandem render X --task NAME",
    "play": "tandem play X --task NAME",
    "publish": "tandem publish RUN --name NAME --alias ALIAS",
    "methods": "tandem methods",
}


def downstream(
    verb: Annotated[str, typer.Argument()] = "", rest: Annotated[list[str] | None, typer.Argument()] = None
) -> None:
    """Say what to type now."""
    now = _NOW.get(verb)
    said = f"tandem downstream {verb} is now {now}" if now else f"tandem downstream is now {', '.join(_NOW.values())}"
    raise TandemError(f"{said}; see docs/cli.md")
