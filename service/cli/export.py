"""``tandem export`` and ``tandem dataset``: what was trained, written for use elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.base.files import check_place
from service.cli.common import (
    REFERENCE,
    SOURCE,
    ActsWithOption,
    JsonOption,
    QuietOption,
    RunCodeOption,
    SourceOption,
    loading,
    print_json,
)
from service.cli.evaluate import GoalsOption, parse_goals

_MAX_FILMED = 16


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
    run_task_code: RunCodeOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write a policy for use elsewhere, such as on a robot: networks, what their numbers mean, a README.

    What is written is compared with the policy itself. The folder appears only when no output differs by more than
    1e-5; with inputs far outside of what the policy meets, 1e-4.
    """
    with loading():
        from service.export.exporting import export as run
        from service.registry.loading import load

        trained = load(policy, registry, primitives, run_task_code=run_task_code)
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


def dataset(
    players: Annotated[
        str,
        typer.Argument(metavar=REFERENCE, help="A run's Alice and Bob, primitives, or a policy of a task."),
    ],
    out: Annotated[
        str, typer.Option(metavar="NAME", help="Of the data set, such as panda-cube; -v0 is added where no -vN is.")
    ],
    episodes: Annotated[int, typer.Option(help="Bob's episodes, or rounds of self-play.", min=1)] = 100,
    goals: GoalsOption = None,
    seed: Annotated[int, typer.Option(help="Of the episodes.", min=0)] = 0,
    video: Annotated[
        Path | None, typer.Option(metavar="FILE", help=f"Film of the first {_MAX_FILMED}, too: .mp4 or .gif.")
    ] = None,
    primitives: ActsWithOption = None,
    registry: SourceOption = SOURCE,
    quiet: QuietOption = False,
) -> None:
    """Write Bob's episodes, or of a run without --goals its self-play, as a Minari data set."""
    with loading():
        from service.config.self_play import SelfPlayConfig
        from service.media import recording
        from service.media.dataset import check_name, played_episodes, played_turns, write_dataset
        from service.media.encoding import check_format
        from service.media.video import write_episode_video, write_video
        from service.registry.loading import load

        name = check_name(out)  # now, not after hours of playing
        if video is not None:
            check_format(video)
            check_place(video)
        trained = load(players, registry, primitives).expect("primitives", "orchestrator", by="tandem dataset")
    trained.goal_kind  # noqa: B018 - what it plays is paid by distance alone
    config = trained.config.model_copy(update={"world": trained.world})
    if trained.alice is not None and isinstance(config, SelfPlayConfig) and goals is None:
        rounds = recording.play_rounds(config, trained.alice, trained.policy, num_rounds=episodes, seed=seed)
        played = played_turns(rounds)
        if video is not None:
            write_video(rounds[:_MAX_FILMED], config.world, video)
    else:
        asked = None if goals is None else parse_goals(goals, config.world)
        if asked is not None and not isinstance(asked, str):
            asked = asked[[index % len(asked) for index in range(episodes)]]
        recorded = recording.record_on_goals(trained, episodes, seed, asked)
        played = played_episodes(recorded)
        if video is not None:
            write_episode_video(recorded.first(_MAX_FILMED), config.world, video)
    place = write_dataset(name, played, config, trained.label, success_distance_m=trained.success_distance_m)
    typer.echo(f"{len(played)} episodes, {sum(len(each.actions) for each in played):,} steps: {name} in {place}")
    if video is not None:
        typer.echo(f"video: {video}")
