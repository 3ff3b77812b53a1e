"""``tandem downstream evaluate``, ``render`` and ``publish``: what is done with what a training has learned."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.common import JsonOption, QuietOption, loading, print_json
from service.cli.film import (
    CAMERA,
    OUT,
    SIZE,
    SPEED,
    CameraOption,
    OutOption,
    SizeOption,
    SpeedOption,
    film_options,
)

ReferenceArgument = Annotated[
    str, typer.Argument(metavar="RUN|NAME@ALIAS", help="Directory of a training, or a published orchestrator.")
]
ActsWithOption = Annotated[
    str | None,
    typer.Option(
        "--primitives", metavar="NAME@ALIAS|RUN_DIR", help="What it acts with, where that has moved since training."
    ),
]
RegistryOption = Annotated[
    str, typer.Option("--registry", envvar="TANDEM_REGISTRY", metavar="DIR|URL", help="Where both come from.")
]
_Task = Annotated[str | None, typer.Option(help="Another task than the one it was trained on.")]
_Seed = Annotated[int, typer.Option(help="Of the episodes.", min=0)]


def evaluate(
    reference: ReferenceArgument,
    task: _Task = None,
    episodes: Annotated[int, typer.Option(help="Number of random goals.", min=1)] = 300,
    seed: _Seed = 0,
    primitives: ActsWithOption = None,
    registry: RegistryOption = "registry",
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Measure an orchestrator on its task, beside Bob as he is and a policy that does nothing.

    With the seed of its training, the goals are those of its result.
    """
    with loading():
        import service
        from service.actors.evaluation import DeterministicPolicy, IdlePolicy
        from service.downstream.playing import FINAL_SEED, evaluate_on
        from service.envs.tasks import SUCCESS_DISTANCE_M, find_task
        from service.primitives.loading import TrainedBob

        found = service.load_policy(reference, registry, primitives)
    on, trained = task or found.task, found.trained
    title = find_task(on).title
    players: dict[str, DeterministicPolicy] = {found.label: found}
    if isinstance(trained, TrainedBob) and found.method != "asp-only":
        players[f"{trained.label}, Bob alone"] = trained.policy
    rows = {
        name: evaluate_on(on, trained.config.world, player, episodes, seed + FINAL_SEED)
        for name, player in (players | {"idle": IdlePolicy()}).items()
    }
    if as_json:
        print_json({"task": on, **{name: row.as_dict() for name, row in rows.items()}})
        return
    typer.echo(f"{title}: {episodes} random goals, within {100 * SUCCESS_DISTANCE_M:g} cm")
    width = max(map(len, rows))
    for name, row in rows.items():
        typer.echo(
            f"  {name:<{width}} at the last step {row.success_last:6.1%}"
            f"  [{row.success_last_low:.1%}, {row.success_last_high:.1%}]"
            f"   ever {row.success_ever:6.1%}   mean distance {row.mean_distance_m:.3f} m"
        )


def render(
    reference: ReferenceArgument,
    task: _Task = None,
    episodes: Annotated[int, typer.Option(help="Episodes to record.", min=1, max=64)] = 4,
    seed: _Seed = 0,
    out: OutOption = OUT,
    size: SizeOption = SIZE,
    camera: CameraOption = CAMERA,
    speed: SpeedOption = SPEED,
    primitives: ActsWithOption = None,
    registry: RegistryOption = "registry",
    quiet: QuietOption = False,
) -> None:
    """Make a film of an orchestrator on its task."""
    with loading():
        import service
        from service.downstream.playing import FINAL_SEED, record_on
        from service.envs.tasks import find_task
        from service.media.video import write_episode_video

        options = film_options(size, camera, speed, out)
        found = service.load_policy(reference, registry, primitives)
    on, world = task or found.task, found.trained.config.world
    recorded = record_on(on, world, found, episodes, seed + FINAL_SEED)
    write_episode_video(recorded, find_task(on).world_from(world), out, options)
    typer.echo(f"video: {out}")


def publish(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Directory of a training that has ended.")],
    name: Annotated[str, typer.Option(help="Of the orchestrator, such as push-orchestrator.")],
    alias: Annotated[str | None, typer.Option(help="Make or move this alias, too.")] = None,
    primitives: Annotated[
        str | None,
        typer.Option(metavar="NAME@ALIAS", help="The published version that it acts with, if it has another name now."),
    ] = None,
    registry: RegistryOption = "registry",
    quiet: QuietOption = False,
) -> None:
    """Publish an orchestrator in the registry, with a reference to the primitives that it belongs to."""
    with loading():
        from service.downstream.orchestrators import publish_orchestrator
        from service.registry.names import check_alias
        from service.registry.registry import Registry

    if alias is not None:
        check_alias(alias)
    found, version = publish_orchestrator(run, name, registry, primitives)
    if alias is not None:
        Registry(Path(registry)).set_alias(version.name, alias, version.number)
    assert found.trained.manifest is not None
    typer.echo(f"{version} is in {registry}: {found.task}, acts with {found.trained.manifest.reference}")
