"""``tandem play`` and ``tandem downstream play``: a live world in the browser."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.common import CHAMPION, EXIT_SIGNAL, REGISTRY, QuietOption, RegistryOption, loading
from service.cli.orchestrators import ActsWithOption, ReferenceArgument
from service.cli.orchestrators import RegistryOption as AnyRegistryOption

if TYPE_CHECKING:
    from service.play.cast import Cast

_Task = Annotated[str | None, typer.Option(help="Play in the world of a downstream task, such as wall.")]
_Host = Annotated[
    str, typer.Option(help="Where to listen; on others than this machine's, all who reach it play along.")
]
_Port = Annotated[int | None, typer.Option(help="Default: 8322, or the next that is free.", min=0, max=65535)]
_Seed = Annotated[int, typer.Option(help="Of starts and goals.", min=0)]


def play(
    primitives: Annotated[
        str, typer.Option(metavar="NAME@ALIAS|RUN_DIR", help="Who plays; a run has Alice.")
    ] = CHAMPION,
    task: _Task = None,
    host: _Host = "127.0.0.1",
    port: _Port = None,
    seed: _Seed = 0,
    registry: RegistryOption = REGISTRY,
    quiet: QuietOption = False,
) -> None:
    """Watch a live world in the browser: drag the goal, drive the primitives, see Alice propose."""

    def make_cast() -> Cast:
        from service.play.cast import cast_primitives

        return cast_primitives(primitives, registry, task)

    _serve(make_cast, host, port, seed)


def play_downstream(
    reference: ReferenceArgument,
    task: _Task = None,
    host: _Host = "127.0.0.1",
    port: _Port = None,
    seed: _Seed = 0,
    primitives: ActsWithOption = None,
    registry: AnyRegistryOption = "registry",
    quiet: QuietOption = False,
) -> None:
    """Watch an orchestrator on its task, live in the browser."""

    def make_cast() -> Cast:
        import service
        from service.play.cast import cast_orchestrator

        return cast_orchestrator(service.load_policy(reference, registry, primitives), task)

    _serve(make_cast, host, port, seed)


def _serve(make_cast: Callable[[], Cast], host: str, port: int | None, seed: int) -> None:
    """Load a cast, and show it until Ctrl-C."""
    with loading():
        from service.play.server import LiveWorld
        from service.runtime.signals import InterruptError, StopSignals

        cast = make_cast()
    with StopSignals() as signals:
        try:
            with loading():
                world = LiveWorld(cast, host, port, seed)
            with world as live, signals.asking(lambda: None):
                typer.echo(f"{cast.label}: {live.url}")
                typer.echo(
                    f"from another machine: ssh -L {live.port}:127.0.0.1:{live.port} {socket.gethostname()}, "
                    f"then http://127.0.0.1:{live.port} there; Ctrl-C ends"
                )
                live.run(lambda: signals.first is not None)
        except InterruptError as interrupt:
            raise typer.Exit(EXIT_SIGNAL + interrupt.number) from None
    typer.echo("stopped")
