"""The command line, thin: parse, call, print. Heavy packages are imported inside the commands."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console

from service.cli.downstream import downstream_app
from service.cli.registry import registry_app
from service.cli.serve import serve
from service.errors import TandemError

if TYPE_CHECKING:
    from service.actors.evaluation import Evaluation
    from service.config import Config
    from service.envs.sampling import GoalKind
    from service.primitives.loading import TrainedBob
    from service.runtime.pretrain import Pretrained
    from service.runtime.ray_connection import ClusterOptions

app = typer.Typer(name="tandem", help="Robot skills, pre-trained.", no_args_is_help=True, add_completion=False)
app.add_typer(registry_app)
app.add_typer(downstream_app)
_console = Console()
_errors = Console(stderr=True)

DEMO_ENV_STEPS = 1_000_000
CHAMPION = "panda-cube@champion"
"""The primitives that come with the package."""
_EXIT_SIGNAL = 128
"""Plus the signal's number: 130 for SIGINT, 143 for SIGTERM."""

_Registry = Annotated[
    Path, typer.Option("--registry", envvar="TANDEM_REGISTRY", metavar="DIR", help="Directory of the registry.")
]
_Runs = Annotated[
    Path, typer.Option("--runs", envvar="TANDEM_RUNS", metavar="DIR", help="Directory of run directories.")
]
_Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="A.B=C", help="Override a key of the configuration; repeatable.")
]
_Primitives = Annotated[str, typer.Option("--primitives", metavar="NAME@ALIAS|RUN_DIR", help="Whose Bob.")]
_Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
_Seed = Annotated[int, typer.Option(help="Of the episodes.", min=0)]


@app.command()
def pretrain(
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="FILE", help="YAML; defaults where left out. Not needed to resume."),
    ] = None,
    run_dir: Annotated[Path | None, typer.Option("--run-dir", metavar="DIR", help="Default: RUNS/NAME.")] = None,
    run_id: Annotated[
        str | None,
        typer.Option("--run-id", metavar="ID", help="Run in RUNS/ID, and continue it if it has begun: for jobs."),
    ] = None,
    runs: _Runs = Path("runs"),
    resume: Annotated[bool, typer.Option("--resume", help="Continue the run in --run-dir exactly.")] = False,
    overrides: _Set = None,
    registry: _Registry = Path("registry"),
    runtime: Annotated[str, typer.Option(help="local: in this process; ray: on a cluster.")] = "local",
    address: Annotated[
        str | None,
        typer.Option(metavar="auto|HOST:PORT", help="Ray cluster; default: the job's, or a new one on this machine."),
    ] = None,
    num_actors: Annotated[
        int | None, typer.Option(help="Rollout actors; default: as many as the cluster has cores.", min=1)
    ] = None,
    learner_cpus: Annotated[
        float, typer.Option(help="Cores reserved for the learner; 0: it shares the actors'.", min=0)
    ] = 0.0,
    status: Annotated[
        str,
        typer.Option(metavar="HOST:PORT|off", help="Where the status service of a run on a cluster listens."),
    ] = "127.0.0.1:8321",
    token_file: Annotated[
        Path | None,
        typer.Option("--token-file", metavar="FILE", help="Its token; default: TANDEM_TOKEN. See tandem serve."),
    ] = None,
) -> None:
    """Pre-train primitives by self-play, in this process or on a Ray cluster, and publish them."""
    with _user_errors():
        from service.config import load_config
        from service.io.run_directory import RunDirectory
        from service.runtime.pretrain import resumed_config

        if runtime not in ("local", "ray"):
            raise TandemError(f"--runtime {runtime!r}: choose one of local, ray")
        if run_id is not None and (resume or run_dir is not None):
            raise TandemError("--run-id names the run directory, and continues what is there: leave out the other two")
        overrides = overrides or []
        if run_id is not None:
            run_dir = runs / run_id
            resume = RunDirectory(run_dir).exists
        if resume:
            if run_dir is None:
                raise TandemError("--resume needs --run-dir, the directory of the run to continue")
            directory = RunDirectory(run_dir)
            resolved = resumed_config(directory, overrides, config)
        else:
            resolved = load_config(config, overrides)
            directory = RunDirectory(run_dir or runs / resolved.name)
        if runtime == "local":
            _pretrain(resolved, directory.path, registry, resume=resume)
            return
        from service.runtime.ray_connection import ClusterOptions, connected, parse_status
        from service.status.token import read_token

        options = ClusterOptions(
            num_actors=num_actors, learner_cpus=learner_cpus, status=parse_status(status, read_token(token_file))
        )
        with connected(address):
            _pretrain(resolved, directory.path, registry, resume=resume, cluster=options)


@app.command()
def demo(
    run_dir: Annotated[Path | None, typer.Option("--run-dir", metavar="DIR", help="Default: runs/demo-N.")] = None,
    env_steps: Annotated[int, typer.Option(help="Budget; the default takes about three minutes on 2 cores.", min=1)] = (
        DEMO_ENV_STEPS
    ),
) -> None:
    """Watch a robot arm teach itself: a small pre-training from scratch, with pictures and a video."""
    with _user_errors():
        from service.config import load_config

        path = run_dir or _next_free(Path("runs"), "demo")
        overrides = [f"run.total_env_steps={env_steps}", "name=panda-cube-demo"]
        _console.print("A robot arm is about to teach itself: Alice proposes goals, Bob learns to reach them.")
        _pretrain(load_config(_demo_config(), overrides), path, path / "registry", resume=False)
        _show_champion()


@app.command()
def evaluate(
    primitives: _Primitives,
    goals: Annotated[
        str, typer.Option(help="table, air, volume or mixed (70 % anywhere in the volume, else table).")
    ] = "mixed",
    episodes: Annotated[int, typer.Option(help="Number of random goals.", min=1)] = 300,
    steps: Annotated[int, typer.Option(help="Steps an episode, 25 a second.", min=1)] = 50,
    seed: _Seed = 0,
    as_json: _Json = False,
    registry: _Registry = Path("registry"),
) -> None:
    """Bob on random goals from fresh resets, without noise, beside a policy that does nothing."""
    with _user_errors():
        from service.envs.sampling import GOAL_KINDS
        from service.primitives.loading import load_bob

        if goals not in GOAL_KINDS:
            raise TandemError(f"--goals {goals!r}: choose one of {', '.join(GOAL_KINDS)}")
        bob = load_bob(primitives, registry)
        rows = _evaluate(bob, goals, episodes, steps, seed)
    if as_json:
        typer.echo(json.dumps({name: row.as_dict() for name, row in rows.items()}, indent=1))
    else:
        _print_evaluation(rows, bob.config.game.success_distance_m)


@app.command()
def coverage(
    primitives: _Primitives,
    skills: Annotated[int, typer.Option(help="Number of random compositions.", min=1)] = 32,
    steps: Annotated[int, typer.Option(help="Steps each.", min=1)] = 100,
    seed: _Seed = 0,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Picture to write.")] = Path("coverage.png"),
    as_json: _Json = False,
    registry: _Registry = Path("registry"),
) -> None:
    """Where random compositions of the primitives move the object, beside a random policy."""
    with _user_errors():
        from service.actors.coverage import RandomPolicy, skill_trajectories, visited_share
        from service.media.plots import plot_coverage
        from service.primitives.loading import load_bob

        bob = load_bob(primitives, registry)
        world = bob.config.world
        paths = {
            name: skill_trajectories(policy, world, num_skills=skills, num_steps=steps, seed=seed)
            for name, policy in ((bob.label, bob.primitives), ("random policy", RandomPolicy()))
        }
        shares = {name: visited_share(path, world.workspace) for name, path in paths.items()}
        picture = plot_coverage(paths[bob.label], world.workspace, out, bob.label)
    if as_json:
        typer.echo(json.dumps({"share_of_table_cells_visited": shares, "picture": str(picture)}, indent=1))
        return
    for name, share in shares.items():
        _say(f"  {name:<24} {share:.0%} of the workspace's table cells visited")
    _say(f"picture: {picture}")


@app.command()
def render(
    primitives: _Primitives,
    episodes: Annotated[int, typer.Option(help="Rounds, or episodes, to record.", min=1)] = 4,
    seed: _Seed = 0,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Video to write.")] = Path("video.mp4"),
    registry: _Registry = Path("registry"),
) -> None:
    """Make a video of a run's Alice beside its Bob, or of published primitives on random goals."""
    with _user_errors():
        from service.io.run_directory import RunDirectory
        from service.media import recording, video
        from service.primitives.loading import load_bob, load_players

        if Path(primitives).is_dir():
            directory = RunDirectory(Path(primitives))
            config = directory.read_config()
            rounds = recording.record_rounds(config, *load_players(directory), num_rounds=episodes, seed=seed)
            video.write_video(rounds, config.world, out)
        else:
            bob = load_bob(primitives, registry)
            recorded = recording.record_episodes(
                bob.policy,
                bob.config.world,
                "mixed",
                num_episodes=episodes,
                num_steps=bob.config.run.evaluation_steps,
                success_distance_m=bob.config.game.success_distance_m,
                seed=seed,
            )
            video.write_episode_video(recorded, bob.config.world, out)
    _say(f"video: {out}")


app.command()(serve)


def _evaluate(bob: TrainedBob, goals: GoalKind, episodes: int, steps: int, seed: int) -> dict[str, Evaluation]:
    from service.actors.evaluation import IdlePolicy
    from service.actors.evaluation import evaluate as run

    return {
        name: run(
            policy,
            bob.config.world,
            goals,
            num_episodes=episodes,
            num_steps=steps,
            seed=seed,
            success_distance_m=bob.config.game.success_distance_m,
        )
        for name, policy in ((bob.label, bob.policy), ("idle", IdlePolicy()))
    }


def _print_evaluation(rows: dict[str, Evaluation], success_distance_m: float) -> None:
    first = next(iter(rows.values()))
    within = f"within {100 * success_distance_m:g} cm"
    _say(f"{first.num_episodes} random goals ({first.goals}), {first.num_steps} steps, {within}")
    for name, row in rows.items():
        _say(
            f"  {name:<24} at the last step {row.success_last:6.1%}"
            f"  [{row.success_last_low:.1%}, {row.success_last_high:.1%}]"
            f"   ever {row.success_ever:6.1%}   mean distance {row.mean_distance_m:.3f} m"
        )


def _say(text: str) -> None:
    """One line each, whatever the width and whatever brackets a path has."""
    _console.print(text, highlight=False, soft_wrap=True, markup=False)


def main() -> None:
    """Entry point of ``tandem`` and ``python -m service``."""
    # NumPy's and torch's own threads only get in each other's way: worlds are stepped by MuJoCo's threads. Both read
    # these variables when they are first imported, which is after this line.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    logging.getLogger("OpenGL").setLevel(logging.WARNING)  # says at INFO which optional module it does without
    app()


def _pretrain(
    config: Config, path: Path, registry: Path, *, resume: bool, cluster: ClusterOptions | None = None
) -> None:
    from service.io.run_directory import RunDirectory
    from service.runtime.pretrain import pretrain as run
    from service.runtime.progress import Progress
    from service.runtime.signals import InterruptError

    try:
        with Progress(config.run.total_env_steps, _console) as progress:
            directory = RunDirectory(path)
            done = run(config, directory, registry, resume=resume, on_iteration=progress.show, cluster=cluster)
    except InterruptError as interrupt:
        _say_stopped("stopped at once", interrupt.number, path, registry)
    _report(done, path, registry)


def _report(done: Pretrained, path: Path, registry: Path) -> None:
    result = done.result
    _say(f"\n{result.reason} after {result.num_env_steps:,} env steps, {result.iteration} iterations")
    _say(done.timing)
    if done.signal is not None:
        rest = "" if result.reason == "interrupted" else ", but not evaluated, published and drawn to the end"
        _say_stopped(f"saved{rest}", done.signal, path, registry)
    for name, value in done.metrics.items():
        _say(f"{name:<36} {value:.1%}")
    for name, file in done.files.items():
        _say(f"{name:<12} {file}")
    _say(f"{'checkpoint':<12} {path / 'checkpoints'}")
    if done.version is not None:
        _say(f"{'primitives':<12} {done.version} in {registry}")


def _say_stopped(what: str, number: int, path: Path, registry: Path) -> NoReturn:
    """How to go on, and the exit code of a process that a signal ends."""
    from service.io.run_directory import RunDirectory

    begun = RunDirectory(path).exists
    how = f"continue with: tandem pretrain --resume --run-dir {path} --registry {registry}"
    _say(f"{what}; {how if begun else 'nothing was saved yet'}")
    raise typer.Exit(_EXIT_SIGNAL + number)


def _show_champion() -> None:
    """What learning for longer gives, and what to type next; the first of it prints the same numbers again."""
    from service.primitives.bundled import BUNDLED
    from service.primitives.loading import load_bob

    bob = load_bob(CHAMPION, BUNDLED)
    _say(f"\nThat was a beginning. Primitives that have learned for longer come with tandem; {CHAMPION}:")
    _print_evaluation(_evaluate(bob, "mixed", 300, 50, seed=0), bob.config.game.success_distance_m)
    _say("\nnext:")
    _say(f"  tandem evaluate --primitives {CHAMPION} --goals mixed --episodes 300")
    _say(f"  tandem render   --primitives {CHAMPION} --out champion.mp4")
    _say(f"  tandem coverage --primitives {CHAMPION} --out champion.png")


def _demo_config() -> Path | None:
    """The shipped recipe, in a clone; an installed wheel has none, and the defaults do."""
    config = Path(__file__).parents[2] / "configs" / "pretrain" / "panda_cube.yaml"
    return config if config.exists() else None


def _next_free(parent: Path, stem: str) -> Path:
    number = 1
    while (parent / f"{stem}-{number}").exists():
        number += 1
    return parent / f"{stem}-{number}"


@contextmanager
def _user_errors() -> Iterator[Any]:
    """One line on stderr for an error the user can mend; the exit code is 2 if it is a mistake in what was typed."""
    try:
        yield
    except TandemError as error:
        _errors.print(f"error: {error}", style=None, highlight=False, soft_wrap=True, markup=False)
        raise typer.Exit(error.exit_code) from None
