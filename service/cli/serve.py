"""``tandem serve``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.common import REGISTRY, RegistryOption


def serve(
    runs: Annotated[Path, typer.Option(metavar="DIR", help="Directory of run directories.")] = Path("runs"),
    registry: RegistryOption = REGISTRY,
    host: Annotated[str, typer.Option(help="Where to listen; others than this machine need a token.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="0 for any that is free.", min=0, max=65535)] = 8321,
    token_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Holds the token; else TANDEM_TOKEN does.")
    ] = None,
) -> None:
    """Show finished and running runs and the registry over REST, to Prometheus, and to a browser."""
    from service.registry.registry import Registry
    from service.status.errors import StatusError
    from service.status.run_reader import open_reader
    from service.status.token import VARIABLE, read_token

    try:
        from service.status.server import StatusServer
    except ImportError as error:
        raise StatusError(f"{error}: pip install 'tandem-skills[cluster]'") from None
    if not runs.is_dir():
        raise StatusError(f"no directory {runs}; name with --runs the one that holds run directories")
    token = read_token(token_file)
    server = StatusServer(open_reader(runs), Registry(registry), token=token, host=host, port=port, runs_dir=runs)
    typer.echo(f"runs of {runs}, primitives of {registry}: {server.url}")
    if token is None:
        typer.echo(f"read-only, for this machine: with {VARIABLE} set, runs can be stopped and aliases moved")
    server.run()
