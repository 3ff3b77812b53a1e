"""``tandem evaluate``, ``coverage`` and ``render``: how good a trained thing is, and what it does; options of films."""

from __future__ import annotations

import re
import sys
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import numpy as np
import typer

from service.base.errors import TandemError, in_metres, one_line
from service.base.files import check_place, write_atomic
from service.cli.common import (
    CHAMPION,
    SOURCE,
    ActsWithOption,
    JsonOption,
    QuietOption,
    ReferenceArgument,
    RunCodeOption,
    SourceOption,
    TaskOption,
    choose,
    loading,
    print_json,
)
from service.config import WorldConfig, changed_config
from service.config.find import METHODS
from service.config.task_methods import TASK_METHODS, find_method
from service.envs.observations import each_object, layouts
from service.store.run_directory import encode_result

if TYPE_CHECKING:
    from pydantic import JsonValue

    from service.actors.evaluation import DeterministicPolicy
    from service.base.types import Metrics, StateArray
    from service.envs.sampling import GoalKind
    from service.media.video import FilmOptions
    from service.registry.loading import Trained

_Seed = Annotated[int, typer.Option(help="Of the episodes.", min=0)]
GoalsOption = Annotated[
    str | None,
    typer.Option(
        "--goals",
        metavar="KIND|POINTS",
        help="table, air, volume, mixed or one; or points in metres, such as '0.1,0,0.2; 0,-0.1,0.025'.",
    ),
]
_SIZES = (64, 4096)


def evaluate(
    reference: ReferenceArgument = CHAMPION,
    task: TaskOption = None,
    method: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Of a task, one that learns nothing: asp-only, idle, or METHOD-zero-shot."),
    ] = None,
    goals: Annotated[
        str | None,
        typer.Option(
            help="table, air, volume or mixed (70 % anywhere in the volume, else table); of several objects one, "
            "which moves one alone. Default: its task's, or mixed."
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Number of random goals.", min=1)] = 300,
    steps: Annotated[
        int | None,
        typer.Option(help="Steps an episode, 25 a second. Default: its task's, or its run's evaluation_steps.", min=1),
    ] = None,
    seed: _Seed = 0,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="world.A=B", help="In another world than that of training; repeatable."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Of a task: write what learns nothing as a run writes its result.json."),
    ] = None,
    primitives: ActsWithOption = None,
    as_json: JsonOption = False,
    registry: SourceOption = SOURCE,
    run_task_code: RunCodeOption = False,
    quiet: QuietOption = False,
) -> None:
    """Measure on random goals, from fresh resets and without noise, beside a policy that does nothing.

    Of skills (all but DADS) the one that leads to the goal acts. A policy of a task plays its task, beside its Bob
    alone; with the seed of its run, the goals are those of its result.
    """
    for override in overrides or ():
        if not override.startswith("world."):
            raise TandemError(f"--set {one_line(override, 200)}: of an evaluation only the world can be set, world.A=B")
    with loading():
        from service.actors.evaluation import evaluate as run
        from service.envs.sampling import GOAL_KINDS
        from service.methods.task_evaluation import FINAL_SEED, numbers_of
        from service.registry.loading import load

        if goals is not None and "," in goals:
            raise TandemError(
                f"--goals {goals!r}: evaluate takes a kind, {', '.join(GOAL_KINDS)}; points are for render"
            )
        asked = None if goals is None else choose("--goals", goals, GOAL_KINDS)
        trained = load(reference, registry, primitives, run_task_code=run_task_code).on(task)
    players, on = _players(trained, method), trained.task
    steps = steps or trained.num_steps
    for option, value in (("--method", method), ("--out", out)):
        if value is not None and on is None:
            raise TandemError(f"{option} is for a task: name one by --task, such as --task push")
    if out is not None and method is None and trained.kind == "orchestrator":
        raise TandemError(f"--out {out}: {trained.label} has learned, and its run has the result.json; leave out --out")
    if out is not None and out.exists():  # now, not after playing
        raise TandemError(f"--out {out} is there already: name another file, or move it away")
    if out is not None:
        check_place(out)
    config = changed_config(trained.config, overrides or ())
    of, first_seed = ("", seed) if on is None else (f" of {on.title}", seed + FINAL_SEED)
    if (num := config.world.num_objects) != (known_num := trained.config.world.num_objects):
        raise TandemError(f"--set: {trained.label} was trained in a world of {known_num}, not of {num} objects")
    seen, known = (list(layouts(each.world).positions.columns) for each in (config, trained.config))
    if seen != known:
        more = ", ".join(sorted(set(seen) ^ set(known)))
        raise TandemError(
            f"--set: {trained.label} sees what it was trained to see, and {more} would be new or gone: leave "
            "world.observed as it is"
        )
    trained = replace(trained, config=config)
    tried = trained.on_goals(cast("GoalKind | None", asked))
    world, distance_m = trained.world, trained.success_distance_m
    with redirect_stdout(sys.stderr):  # what functions of a task print is no result
        rows = {
            name: run(
                player, world, tried,
                num_episodes=episodes, num_steps=steps, seed=first_seed, success_distance_m=distance_m,
            )
            for name, player in players.items()
        }  # fmt: skip
    if out is not None:
        _write_result(out, trained, method, seed, numbers_of(next(iter(rows.values()))))
    if as_json:
        found = {name: row.as_dict() for name, row in rows.items()}
        print_json(found if on is None else {"task": on.name, **found})
        return
    what = f"within {100 * distance_m:g} cm" if tried.success is None else "success as the task says"
    drawn = "its own" if callable(tried.goals) else tried.goals
    typer.echo(f"{episodes} random goals{of} ({drawn}), {steps} steps, {what}")
    width = max(24, *map(len, rows))
    for name, row in rows.items():
        typer.echo(
            f"  {name:<{width}} at the last step {row.success_last:6.1%}"
            f"  [{row.success_last_low:.1%}, {row.success_last_high:.1%}]"
            f"   ever {row.success_ever:6.1%}   mean distance {row.mean_distance_m:.3f} m"
        )


def _players(trained: Trained, method: str | None) -> dict[str, DeterministicPolicy]:
    """The policies that are measured, by name."""
    from service.actors.evaluation import IdlePolicy
    from service.methods.task_check import check_fits

    players: dict[str, DeterministicPolicy] = {}
    if method in METHODS:
        raise TandemError(f"--method {method} learns: tandem train TASK --method {method}, then evaluate that run")
    if method is not None:
        check_fits(find_method(method), trained)
    if method != "idle":
        players[trained.label] = trained.expect_goals("tandem evaluate").player()
    bob = trained.acts_with
    if bob is not None and bob.kind == "primitives" and method is None:
        players[f"{bob.label}, Bob alone"] = bob.policy
    return players | {"idle": IdlePolicy()}


def _write_result(path: Path, trained: Trained, method: str | None, seed: int, numbers: Metrics) -> None:
    """Write a file that says what a run's configuration and result say."""
    method = method or ("asp-only" if trained.kind == "primitives" else f"{trained.skills.method}-zero-shot")
    takes = method not in TASK_METHODS or TASK_METHODS[method].takes is not None
    result: dict[str, JsonValue] = {
        "task": None if trained.task is None else trained.task.name,
        "method": method,
        "seed": seed,
        "primitives": trained.name if takes else None,
        "primitives_digest": trained.digest if takes else None,
        "evaluation": dict(numbers),
        "env_steps": 0,
        "wall_s": 0.0,
    }
    write_atomic(path, encode_result(result))


def coverage(
    reference: ReferenceArgument = CHAMPION,
    skills: Annotated[int, typer.Option(help="Number of random compositions, or skills.", min=1)] = 32,
    steps: Annotated[int, typer.Option(help="Steps each.", min=1)] = 100,
    seed: _Seed = 0,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Picture to write.")] = Path("coverage.png"),
    as_json: JsonOption = False,
    registry: SourceOption = SOURCE,
    quiet: QuietOption = False,
) -> None:
    """Plot where random compositions of the primitives, or random skills, move the object, beside a random policy."""
    check_place(out)
    if out.suffix.lower() != ".png":
        raise TandemError(f"--out {out}: the picture is a PNG; name a file that ends in .png")
    with loading():
        from service.actors.coverage import RandomPolicy, composition_paths, visited_share
        from service.media.artifacts import paths_of
        from service.media.plots import plot_coverage
        from service.registry.loading import load

        trained = load(reference, registry).expect("primitives", "skills", by="tandem coverage")
    world = trained.world
    path, of = paths_of(trained, skills, steps, seed)
    random = composition_paths(RandomPolicy(), world, num_skills=skills, num_steps=steps, seed=seed)
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
    reference: ReferenceArgument = CHAMPION,
    task: TaskOption = None,
    episodes: Annotated[int, typer.Option(help="Rounds, episodes or skills to record.", min=1, max=64)] = 4,
    goals: GoalsOption = None,
    seed: _Seed = 0,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Film to write: .mp4 or .gif.")] = Path("video.mp4"),
    size: Annotated[str, typer.Option(metavar="WxH", help="Of the whole film, pixels.")] = "1280x720",
    camera: Annotated[
        str,
        typer.Option(
            metavar="VIEW",
            help="front, far, close, side, behind or top; also, or after it, azimuth=DEG,elevation=DEG,distance=M.",
        ),
    ] = "front",
    speed: Annotated[float, typer.Option(help="0.5: half as fast as in the world.", min=0.05, max=20)] = 1.0,
    primitives: ActsWithOption = None,
    registry: SourceOption = SOURCE,
    run_task_code: RunCodeOption = False,
    quiet: QuietOption = False,
) -> None:
    """Make a film of a run's Alice beside its Bob, of a policy on goals or on its task, or of random skills."""
    with loading():
        from service.media.artifacts import film
        from service.methods.task_evaluation import FINAL_SEED
        from service.registry.loading import load

        options = film_options(size, camera, speed, out)
        trained = load(reference, registry, primitives, run_task_code=run_task_code).on(task)
    if trained.kind == "skills" and trained.task is None and goals is not None:
        raise TandemError(f"--goals: {trained.label} holds skills, of which random ones are shown; leave it out")
    asked = None if goals is None else parse_goals(goals, trained.world)
    film(trained, out, episodes, seed if trained.task is None else seed + FINAL_SEED, options, asked)
    typer.echo(f"video: {out}")


def film_options(size: str, camera: str, speed: float, out: Path) -> FilmOptions:
    """How a film shall look.

    Raises:
        TandemError: a size, camera, speed or end of the file's name that no film has.
    """
    from service.envs.rendering.camera import parse_view
    from service.media.encoding import check_format
    from service.media.video import FilmOptions

    check_format(out)
    check_place(out)
    found = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", size)
    width, height = map(int, found.groups()) if found else (0, 0)
    if any(side % 2 or not _SIZES[0] <= side <= _SIZES[1] for side in (width, height)):
        raise TandemError(
            f"--size {size!r}: write WIDTHxHEIGHT, even numbers from {_SIZES[0]} to {_SIZES[1]}, such as 1280x720"
        )
    return FilmOptions(width, height, parse_view(camera), speed)


def parse_goals(text: str, world: WorldConfig) -> GoalKind | StateArray:
    """A kind of random goals, or (N, 3 K) goals in metres.

    Raises:
        TandemError: neither; or as for ``parse_points``.
    """
    from service.envs.sampling import GOAL_KINDS, check_goals

    for kind in GOAL_KINDS:
        if text.strip() == kind:
            check_goals(kind, world)
            return kind
    return parse_points("--goals", text, world, f"one of {', '.join(GOAL_KINDS)}, or points with ; between, each")


def parse_points(option: str, text: str, world: WorldConfig, expected: str) -> StateArray:
    """(N, 3 K) goals in metres.

    Args:
        option: they were typed for.
        text: as it was typed.
        world: that they are in.
        expected: words for what can be typed, up to its form.

    Raises:
        TandemError: no points; or one outside of the workspace, inside the table or a fixture, or of objects inside
            each other.
    """
    from service.envs.overlap import inside_each_other, inside_fixtures, inside_table

    try:
        points = np.array([[float(part) for part in point.split(",")] for point in text.strip("; ").split(";")])
    except ValueError:
        points = np.empty(0)
    if points.shape[1:] != (3 * world.num_objects,) or not np.isfinite(points).all():
        each = ",".join(["x,y,z"] * world.num_objects)
        raise TandemError(f"{option} {text!r}: write {expected} {each} in metres")
    low, high = np.round((world.workspace.lower_m, world.workspace.upper_m), 6)  # sums, such as 0.12499999999999999
    for point in points[(each_object(points) != np.clip(each_object(points), low, high)).any(axis=(1, 2))]:
        raise TandemError(
            f"{option}: {in_metres(point)} is outside of the workspace, ({in_metres(low)}) to ({in_metres(high)}) m"
        )
    for point in points[inside_table(points, world)]:
        lowest = " and ".join(f"{height_m:g}" for height_m in world.rest_heights_m)
        raise TandemError(
            f"{option}: {in_metres(point)} is inside the table: a goal is for the object's centre, which lies {lowest} "
            "m high there"
        )
    for point in points[inside_fixtures(points, world)]:
        raise TandemError(
            f"{option}: at {in_metres(point)} an object would be inside a fixture, or the upright box around it"
        )
    for point in points[inside_each_other(points, world)]:
        raise TandemError(f"{option}: at {in_metres(point)} objects would be inside each other")
    return points
