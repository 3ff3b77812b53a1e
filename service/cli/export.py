"""``tandem export``: a policy as one folder that needs nothing of tandem."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.common import (
    REFERENCE,
    SOURCE,
    ActsWithOption,
    JsonOption,
    QuietOption,
    SourceOption,
    loading,
    print_json,
)


def export(
    policy: Annotated[
        str,
        typer.Argument(
            metavar=REFERENCE,
            help="Primitives, or a policy of a task: a version, or the path of a run or checkpoint.",
        ),
    ],
    format_name: Annotated[str, typer.Option("--format", help="onnx, numpy or torchscript.")],
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="To make; must not be there yet.")],
    part: Annotated[
        str, typer.Option(help="policy, primitives (each by itself), or all that there is.", metavar="PART")
    ] = "all",
    primitives: ActsWithOption = None,
    episodes: Annotated[int, typer.Option(help="Played for each delay that is measured.", min=1)] = 100,
    as_json: JsonOption = False,
    registry: SourceOption = SOURCE,
    quiet: QuietOption = False,
) -> None:
    """Write a policy for use elsewhere, such as on a robot: networks, what their numbers mean, a README.

    What is written is compared with the policy itself. The folder appears only when no output differs by more than
    1e-5; with inputs far outside of what the policy meets, 1e-4.
    """
    with loading():
        from service.export.exporting import export as run
        from service.registry.loading import load

        trained = load(policy, registry, primitives)
    about = run(trained, format_name, out, part=part, num_episodes=episodes)
    if as_json:
        print_json(about)
        return
    usual = max(network["max_abs_difference"] for network in about["networks"])
    extreme = max(network["max_abs_difference_extreme"] for network in about["networks"])
    for network in about["networks"]:
        typer.echo(f"  {network['file']:<20} {network['title']}")
    typer.echo(
        f"{about['name']} is in {out}, within {usual:.1e} of the policy itself (with extreme inputs {extreme:.1e}); "
        "begin with its README.md"
    )
