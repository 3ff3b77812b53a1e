"""``tandem serve`` and ``tandem play``: runs, the registry and a live world in the browser."""

from __future__ import annotations

import socket
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Annotated

import typer

from service.base.errors import StatusError, needs_extra
from service.cli.common import (
    CHAMPION,
    REGISTRY,
    SOURCE,
    ActsWithOption,
    QuietOption,
    ReferenceArgument,
    RegistryOption,
    RunCodeOption,
    SourceOption,
    TaskOption,
    loading,
)
from service.registry.registry import Registry
from service.registry.token import VARIABLE, read_token
from service.runs.signals import StopSignals


def serve(
    runs: Annotated[
        Path, typer.Option(envvar="TANDEM_RUNS", metavar="DIR", help="Directory of run directories.")
    ] = Path("runs"),
    registry: RegistryOption = REGISTRY,
    host: Annotated[str, typer.Option(help="Where to listen; others than this machine need a token.")] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option(help="0 for any that is free. Default: 8321, or the next free one.", min=0, max=65535),
    ] = None,
    token_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Holds the token; else TANDEM_TOKEN does.")
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Show finished and running runs and the registry over REST, to Prometheus, and to a browser."""
    from service.base.ports import choose_port
    from service.status.run_reader import open_reader

    with needs_extra("serve", "tandem serve"):
        from service.status.server import StatusServer
    if not runs.is_dir():
        raise StatusError(f"no directory {runs}; name with --runs the one that holds run directories")
    token = read_token(token_file)
    chosen = choose_port(host, port)
    server = StatusServer(open_reader(runs), Registry(registry), token=token, host=host, port=chosen)
    typer.echo(f"runs of {runs}, primitives of {registry}: {server.url}")
    if token is None:
        typer.echo(f"read-only, for this machine: with {VARIABLE} set, runs can be stopped and aliases moved")
    with StopSignals() as signals, signals.asking(lambda: None):
        server.run(lambda: signals.first is not None)


def play(
    reference: ReferenceArgument = CHAMPION,
    task: TaskOption = None,
    host: Annotated[
        str, typer.Option(help="Where to listen; on others than this machine's, all who reach it play along.")
    ] = "127.0.0.1",
    port: Annotated[int | None, typer.Option(help="Default: 8322, or the next that is free.", min=0, max=65535)] = None,
    seed: Annotated[int, typer.Option(help="Of starts and goals.", min=0)] = 0,
    primitives: ActsWithOption = None,
    registry: SourceOption = SOURCE,
    run_task_code: RunCodeOption = False,
    quiet: QuietOption = False,
) -> None:
    """Watch a live world in the browser: drag the goal, drive the primitives, see a run's Alice propose.

    A run that goes on is followed: its newest Bob acts, and the page says how far it is.
    """
    with loading():
        from service.registry.loading import load
        from service.robot.play.following import Following, is_running
        from service.robot.play.server import LiveWorld

        players = (
            load(reference, registry, primitives, run_task_code=run_task_code).expect_goals("tandem play").on(task)
        )
    path = Path(reference)
    with StopSignals() as signals, ExitStack() as stack:
        follows = task is None and is_running(path)
        following = stack.enter_context(closing(Following(path, registry, primitives))) if follows else None
        with loading():
            world = LiveWorld(players, host, port, seed, following)
        with closing(world) as live, signals.asking(lambda: None):
            typer.echo(f"{players.title}: {live.url}")
            typer.echo(
                f"from another machine: ssh -L {live.port}:127.0.0.1:{live.port} {socket.gethostname()}, "
                f"then http://127.0.0.1:{live.port} there; Ctrl-C ends"
            )
            live.run(lambda: signals.first is not None)
    typer.echo("stopped")
