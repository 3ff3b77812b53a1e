"""``tandem downstream evaluate``, ``render`` and ``publish``: what is done with what a training has learned."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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

if TYPE_CHECKING:
    from service.primitives.loading import Trained

ReferenceArgument = Annotated[
    str, typer.Argument(metavar=REFERENCE, help="Directory of a training, or a published orchestrator.")
]
_Task = Annotated[str | None, typer.Option(help="Another task than the one it was trained on, if it was.")]
_Seed = Annotated[int, typer.Option(help="Of the episodes.", min=0)]


def load_on_task(
    reference: str, registry: str, primitives: str | None, task: str | None, *, by: str
) -> tuple[Trained, str]:
    """A policy, and the task that it shall play: that of ``--task``, or its own.

    Raises:
        TandemError: see ``service.load``; or it has no task, or no goals.
    """
    from service.primitives.loading import load

    found = load(reference, registry, primitives).expect_goals(by)
    if task is None:
        found.expect("orchestrator", by=f"{by} without --task")
    on = task or found.task
    assert on is not None
    return found, on


def evaluate(
    reference: ReferenceArgument,
    task: _Task = None,
    episodes: Annotated[int, typer.Option(help="Number of random goals.", min=1)] = 300,
    seed: _Seed = 0,
    primitives: ActsWithOption = None,
    registry: SourceOption = SOURCE,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Measure a policy on its task, beside Bob as he is and a policy that does nothing.

    With the seed of its training, the goals are those of its result.
    """
    with loading():
        from service.actors.evaluation import DeterministicPolicy, IdlePolicy
        from service.downstream.playing import FINAL_SEED, evaluate_on
        from service.envs.tasks import SUCCESS_DISTANCE_M, find_task

        found, on = load_on_task(reference, registry, primitives, task, by="tandem downstream evaluate")
    title, trained = find_task(on).title, found.trained
    players: dict[str, DeterministicPolicy] = {found.label: found}
    if trained is not None and trained.kind == "primitives" and found.policy is not trained.policy:
        players[f"{trained.label}, Bob alone"] = trained.policy
    rows = {
        name: evaluate_on(on, found.config.world, player, episodes, seed + FINAL_SEED)
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
    registry: SourceOption = SOURCE,
    quiet: QuietOption = False,
) -> None:
    """Make a film of a policy on its task."""
    with loading():
        from service.downstream.playing import FINAL_SEED, record_on
        from service.envs.tasks import find_task
        from service.media.video import write_episode_video

        options = film_options(size, camera, speed, out)
        found, on = load_on_task(reference, registry, primitives, task, by="tandem downstream render")
    world = found.config.world
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
    registry: SourceOption = SOURCE,
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
    assert found.trained is not None
    assert found.trained.manifest is not None
    typer.echo(f"{version} is in {registry}: {found.task}, acts with {found.trained.manifest.reference}")
