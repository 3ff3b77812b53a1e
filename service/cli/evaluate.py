"""``tandem evaluate``, ``coverage`` and ``render``: how good trained primitives are, and what they do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from service.cli.common import (
    CHAMPION,
    REFERENCE,
    SOURCE,
    JsonOption,
    QuietOption,
    SourceOption,
    choose,
    loading,
    print_json,
)
from service.cli.film import (
    CAMERA,
    OUT,
    SIZE,
    SPEED,
    CameraOption,
    GoalsOption,
    OutOption,
    SizeOption,
    SpeedOption,
    film_options,
    parse_goals,
)
from service.errors import TandemError, one_line

if TYPE_CHECKING:
    from service.envs.sampling import GoalKind

_Primitives = Annotated[
    str,
    typer.Option(metavar=REFERENCE, help="A version; or a run, checkpoint, training or exported version."),
]
_Seed = Annotated[int, typer.Option(help="Of the episodes.", min=0)]


def evaluate(
    primitives: _Primitives,
    goals: Annotated[
        str | None,
        typer.Option(
            help="table, air, volume or mixed (70 % anywhere in the volume, else table). Default: its task's, or mixed."
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Number of random goals.", min=1)] = 300,
    steps: Annotated[int, typer.Option(help="Steps an episode, 25 a second.", min=1)] = 50,
    seed: _Seed = 0,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="world.A=B", help="In another world than that of training; repeatable."),
    ] = None,
    as_json: JsonOption = False,
    registry: SourceOption = SOURCE,
    quiet: QuietOption = False,
) -> None:
    """Bob on random goals from fresh resets, without noise, beside a policy that does nothing.

    Of skills (LSD, METRA, DIAYN) the one that leads to the goal acts, zero-shot. A policy of a task plays its task.
    """
    for override in overrides or ():
        if not override.startswith("world."):
            raise TandemError(f"--set {one_line(override, 200)}: of an evaluation only the world can be set, world.A=B")
    with loading():
        from service.actors.evaluation import IdlePolicy
        from service.actors.evaluation import evaluate as run
        from service.config import changed_config
        from service.envs.observations import layouts
        from service.envs.sampling import GOAL_KINDS
        from service.primitives.loading import load

        asked = None if goals is None else choose("--goals", goals, GOAL_KINDS)
        trained = load(primitives, registry).expect_goals("tandem evaluate")
    config = changed_config(trained.config, overrides or ())
    world, distance_m = replace(trained, config=config).world, trained.success_distance_m
    kind = cast("GoalKind", asked or ("mixed" if trained.task is None else trained.goals))
    seen, known = (list(layouts(each.world).positions.columns) for each in (config, trained.config))
    if seen != known:
        more = ", ".join(sorted(set(seen) ^ set(known)))
        raise TandemError(
            f"--set: {trained.label} sees what it was trained to see, and {more} would be new or gone: leave "
            "world.observed as it is"
        )
    rows = {
        name: run(policy, world, kind, num_episodes=episodes, num_steps=steps, seed=seed, success_distance_m=distance_m)
        for name, policy in ((trained.label, trained), ("idle", IdlePolicy()))
    }
    if as_json:
        print_json({name: row.as_dict() for name, row in rows.items()})
        return
    typer.echo(f"{episodes} random goals ({kind}), {steps} steps, within {100 * distance_m:g} cm")
    for name, row in rows.items():
        typer.echo(
            f"  {name:<24} at the last step {row.success_last:6.1%}"
            f"  [{row.success_last_low:.1%}, {row.success_last_high:.1%}]"
            f"   ever {row.success_ever:6.1%}   mean distance {row.mean_distance_m:.3f} m"
        )


def coverage(
    primitives: _Primitives,
    skills: Annotated[int, typer.Option(help="Number of random compositions, or skills.", min=1)] = 32,
    steps: Annotated[int, typer.Option(help="Steps each.", min=1)] = 100,
    seed: _Seed = 0,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Picture to write.")] = Path("coverage.png"),
    as_json: JsonOption = False,
    registry: SourceOption = SOURCE,
    quiet: QuietOption = False,
) -> None:
    """Plot where random compositions of the primitives, or random skills, move the object, beside a random policy."""
    if out.suffix.lower() != ".png":
        raise TandemError(f"--out {out}: the picture is a PNG; name a file that ends in .png")
    with loading():
        from service.actors.coverage import RandomPolicy, skill_trajectories, visited_share
        from service.baselines.coverage import skill_paths
        from service.media.plots import plot_coverage
        from service.primitives.loading import load

        trained = load(primitives, registry).expect("primitives", "skills", by="tandem coverage")
    world = trained.world
    if trained.kind == "primitives":
        of, path = (
            "composition",
            skill_trajectories(trained.primitives, world, num_skills=skills, num_steps=steps, seed=seed),
        )
    else:
        of, path = "skill", skill_paths(trained.skills, world, num_skills=skills, num_steps=steps, seed=seed)
    random = skill_trajectories(RandomPolicy(), world, num_skills=skills, num_steps=steps, seed=seed)
    paths = {trained.label: path, "random policy": random}
    shares = {name: visited_share(path, world.workspace) for name, path in paths.items()}
    picture = plot_coverage(path, world.workspace, out, trained.label, of=of)
    if as_json:
        print_json({"share_of_table_cells_visited": shares, "picture": str(picture)})
        return
    for name, share in shares.items():
        typer.echo(f"  {name:<24} {share:.0%} of the workspace's table cells visited")
    typer.echo(f"picture: {picture}")


def render(
    primitives: _Primitives = CHAMPION,
    episodes: Annotated[int, typer.Option(help="Rounds, episodes or skills to record.", min=1, max=64)] = 4,
    goals: GoalsOption = None,
    seed: _Seed = 0,
    out: OutOption = OUT,
    size: SizeOption = SIZE,
    camera: CameraOption = CAMERA,
    speed: SpeedOption = SPEED,
    registry: SourceOption = SOURCE,
    quiet: QuietOption = False,
) -> None:
    """Make a film of a run's Alice beside its Bob, of a policy on goals or on its task, or of random skills."""
    with loading():
        from service.media import recording, video
        from service.primitives.loading import load

        options = film_options(size, camera, speed, out)
        trained = load(primitives, registry)
    config = trained.config
    if trained.kind == "skills":
        assert config.skills is not None
        if goals is not None:
            raise TandemError(f"--goals: {trained.label} holds skills, of which random ones are shown; leave it out")
        recorded = recording.record_skills(
            trained.skills, config.world, num_skills=episodes, num_steps=config.skills.episode_steps, seed=seed
        )
        video.write_episode_video(recorded, config.world, out, options)
    elif trained.alice is not None and goals is None:
        rounds = recording.record_rounds(config, trained.alice, trained.policy, num_rounds=episodes, seed=seed)
        video.write_video(rounds, config.world, out, options)
    else:
        asked = parse_goals(goals or ("mixed" if trained.task is None else trained.goals), trained.world)
        points = None if isinstance(asked, str) else asked
        recorded = recording.record_episodes(
            trained.policy,
            trained.world,
            asked if isinstance(asked, str) else "mixed",
            num_episodes=episodes if points is None else len(points),
            num_steps=trained.num_steps,
            success_distance_m=trained.success_distance_m,
            seed=seed,
            goal=points,
        )
        video.write_episode_video(recorded, trained.world, out, options)
    typer.echo(f"video: {out}")
