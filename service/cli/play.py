"""``tandem play``: a live world in the browser."""

from __future__ import annotations

import socket
from typing import Annotated

import typer

from service.cli.common import (
    EXIT_SIGNAL,
    SOURCE,
    ActsWithOption,
    QuietOption,
    ReferenceArgument,
    SourceOption,
    TaskOption,
    loading,
    what_is_meant,
)

_Host = Annotated[
    str, typer.Option(help="Where to listen; on others than this machine's, all who reach it play along.")
]
_Port = Annotated[int | None, typer.Option(help="Default: 8322, or the next that is free.", min=0, max=65535)]
_Seed = Annotated[int, typer.Option(help="Of starts and goals.", min=0)]


def play(
    reference: ReferenceArgument = None,
    task: TaskOption = None,
    host: _Host = "127.0.0.1",
    port: _Port = None,
    seed: _Seed = 0,
    primitives: ActsWithOption = None,
    registry: SourceOption = SOURCE,
    quiet: QuietOption = False,
) -> None:
    """Watch a live world in the browser: drag the goal, drive the primitives, see a run's Alice propose."""
    reference, primitives = what_is_meant(reference, primitives)
    with loading():
        from service.registry.loading import load
        from service.robot.play.server import LiveWorld
        from service.runs.signals import InterruptError, StopSignals

        players = load(reference, registry, primitives).expect_goals("tandem play").on(task)
    with StopSignals() as signals:
        try:
            with loading():
                world = LiveWorld(players, host, port, seed)
            with world as live, signals.asking(lambda: None):
                typer.echo(f"{players.title}: {live.url}")
                typer.echo(
                    f"from another machine: ssh -L {live.port}:127.0.0.1:{live.port} {socket.gethostname()}, "
                    f"then http://127.0.0.1:{live.port} there; Ctrl-C ends"
                )
                live.run(lambda: signals.first is not None)
        except InterruptError as interrupt:
            raise typer.Exit(EXIT_SIGNAL + interrupt.number) from None
    typer.echo("stopped")
