"""``tandem publish``: what a run has learned, published by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.common import SOURCE, ActsWithOption, QuietOption, SourceOption, loading


def publish(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Directory of a run that no process is running.")],
    name: Annotated[str | None, typer.Option(help="Of what is published. Default: that of the run.")] = None,
    alias: Annotated[str | None, typer.Option(help="Make or move this alias, too.")] = None,
    primitives: ActsWithOption = None,
    registry: SourceOption = SOURCE,
    quiet: QuietOption = False,
) -> None:
    """Measure what a run has learned until now, and publish it: primitives, skills or a policy of a task."""
    with loading():
        from service.registry.names import check_alias
        from service.registry.registry import Registry
        from service.runs.publishing import publish_learned

    if alias is not None:
        check_alias(alias)
    version = publish_learned(run, registry, name, primitives)
    if alias is not None:
        Registry(Path(registry)).set_alias(version.name, alias, version.number)
    typer.echo(f"{version} is in {registry}")
