"""``tandem downstream``: learn a task with frozen primitives, and the table of all methods on all tasks."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.common import (
    CHAMPION,
    EXIT_SIGNAL,
    REFERENCE,
    SOURCE,
    CommandGroup,
    QuietOption,
    SourceOption,
    TrackerOption,
    choose,
    loading,
    print_json,
    print_table,
    shown,
)
from service.cli.orchestrators import evaluate, publish, render
from service.cli.play import play_downstream
from service.cli.unexpected import traceback_in
from service.errors import TandemError, did_you_mean, one_line
from service.progress import answer
from service.trackers import Trackers

if TYPE_CHECKING:
    from service.downstream.table import Runner
    from service.downstream.worker import Callbacks
    from service.runs.signals import StopSignals

downstream_app = typer.Typer(
    name="downstream", help="New tasks with frozen primitives.", cls=CommandGroup, no_args_is_help=True
)
for command in (evaluate, render, publish):
    downstream_app.command()(command)
downstream_app.command("play")(play_downstream)


def _task_names() -> list[str]:
    """What the shell completes."""
    from service.envs.tasks import HARD_TASKS, TASKS

    return [*TASKS, *HARD_TASKS]


def _method_names() -> list[str]:
    """What the shell completes."""
    from service.downstream.methods import METHODS

    return list(METHODS)


_Primitives = Annotated[str, typer.Option(metavar=REFERENCE, help="What a method takes: primitives or skills.")]
_Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="A=B", help="How SAC learns, such as gamma=0.9; repeatable.")
]
_Steps = Annotated[int | None, typer.Option(help="Env steps of learning.", min=1)]
_SkillSteps = Annotated[int | None, typer.Option(help="Env steps that a skill is held.", min=1)]
_RewardMargin = Annotated[
    float | None, typer.Option("--reward-margin-m", help="While learning, goals count as reached this much nearer.")
]
_Episodes = Annotated[int, typer.Option(help="Of the final evaluation.", min=1)]
_Threads = Annotated[
    int | None,
    typer.Option(help="Threads of a training. Default: one that learns, and worlds on all cores; on Ray one.", min=1),
]


@downstream_app.command()
def train(
    task: Annotated[str, typer.Option(autocompletion=_task_names, help="larger, inair, push, sphere, wall or box.")],
    method: Annotated[str, typer.Option(autocompletion=_method_names, help="See tandem downstream methods.")] = "ours",
    primitives: _Primitives = CHAMPION,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    steps: _Steps = None,
    skill_steps: _SkillSteps = None,
    reward_margin_m: _RewardMargin = None,
    episodes: _Episodes = 300,
    run_dir: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Default: runs/downstream/TASK-METHOD-SEED.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue exactly; where nothing is, begin.")] = False,
    overrides: _Set = None,
    registry: SourceOption = SOURCE,
    threads: _Threads = None,
    publish_as: Annotated[
        str | None, typer.Option("--publish", metavar="NAME", help="Publish what was learned by this name.")
    ] = None,
    tracker: TrackerOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Learn one task, evaluate, record a video."""
    with loading():
        from service.downstream.methods import load_for
        from service.downstream.orchestrators import check_publishable, publish_orchestrator
        from service.downstream.settings import make_trial
        from service.downstream.worker import RunOptions, run_trial

    trial = make_trial(
        task=task,
        method=method,
        seed=seed,
        num_episodes=episodes,
        **_learning(steps, skill_steps, reward_margin_m, overrides),
    )
    _check_used(trial.method, steps, skill_steps, reward_margin_m, overrides)
    path = run_dir or Path("runs") / "downstream" / trial.name
    named = {**trial.model_dump(mode="json"), "primitives": primitives}
    with (
        _stop_on_signals() as (callbacks, signals),
        Trackers(tracker or [], path.name, named) as tracked,
    ):
        callbacks = dataclasses.replace(callbacks, on_iteration=tracked.log)
        options = RunOptions(resume, threads or 0, video=True, callbacks=callbacks)
        trained = load_for([method], primitives, registry)
        if publish_as is not None:
            check_publishable(trial.method, trained, publish_as, registry)  # now, not after the training
        with traceback_in(path):
            result = run_trial(trial, trained, path, options)
        if result is not None:
            tracked.log({"env_steps": result["env_steps"], **_final(result["evaluation"])})
    if result is None:
        typer.echo(f"saved; continue with the same command and --resume --run-dir {path}", err=True)
        raise typer.Exit(EXIT_SIGNAL + (signals.first or 0))
    if publish_as is not None:
        _, version = publish_orchestrator(path, publish_as, registry, primitives)
        typer.echo(f"{version} is in {registry}", err=True)
    if as_json:
        print_json(result)
        return
    found = result["evaluation"]
    typer.echo(
        f"{trial.name}: at the last step {found['success_last']:.1%} [{found['success_last_low']:.1%}, "
        f"{found['success_last_high']:.1%}], ever {found['success_ever']:.1%}, of {found['num_episodes']} episodes"
    )
    typer.echo(f"{result['env_steps']:,} env steps in {result['wall_s']:.0f} s; {path}")


def _final(evaluation: dict[str, Any]) -> dict[str, float]:
    """The numbers of a result's evaluation, as trackers get them."""
    return {f"final/{name}": value for name, value in evaluation.items() if isinstance(value, int | float)}


@downstream_app.command()
def table(
    methods: Annotated[str, typer.Option(help="Names with commas between; all: those that take no skills.")] = "all",
    tasks: Annotated[str, typer.Option(help="Names with commas between; all: the paper's six.")] = "all",
    seeds: Annotated[str, typer.Option(help="Numbers with commas between.")] = "0",
    primitives: _Primitives = CHAMPION,
    steps: _Steps = None,
    skill_steps: _SkillSteps = None,
    reward_margin_m: _RewardMargin = None,
    episodes: _Episodes = 300,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Has one file for each trial, in its downstream/.")] = Path(
        "results"
    ),
    runs: Annotated[Path, typer.Option(metavar="DIR", help="Trainings, to continue them.")] = Path("runs/downstream"),
    overrides: _Set = None,
    registry: SourceOption = SOURCE,
    runtime: Annotated[str, typer.Option(help="local: in this process; ray: many at once on a cluster.")] = "local",
    address: Annotated[
        str | None, typer.Option(metavar="auto|HOST:PORT", help="Ray cluster; default: a new one on this machine.")
    ] = None,
    num_workers: Annotated[int | None, typer.Option(help="Trainings at once; default: one a core.", min=1)] = None,
    threads: _Threads = None,
    quiet: QuietOption = False,
) -> None:
    """Run the trials that are missing, and print the success of every method on every task."""
    from service.downstream.methods import METHODS
    from service.downstream.settings import make_trial
    from service.downstream.table import Source, make_table, success_table
    from service.envs.tasks import TASKS

    learning = _learning(steps, skill_steps, reward_margin_m, overrides)
    trials = [
        make_trial(task=task, method=method, seed=seed, num_episodes=episodes, **learning)
        for seed in _numbers(seeds)
        for task in _names(tasks, TASKS)
        for method in _names(methods, [name for name, each in METHODS.items() if each.takes != "skills"])
    ]
    source = Source(primitives, registry, runs.absolute())
    with _make_runner(runtime, address, num_workers, threads) as runner, _stop_on_signals() as (callbacks, signals):
        complete = make_table(list(dict.fromkeys(trials)), source, out, runner, callbacks)
    if not complete:
        typer.echo("stopped; the same command continues", err=True)
        raise typer.Exit(EXIT_SIGNAL + (signals.first or 0))
    head, *rows = success_table(out)
    print_table(head, rows)


@downstream_app.command("methods")
def list_methods() -> None:
    """List the methods."""
    from service.downstream.methods import METHODS

    for name, method in METHODS.items():
        typer.echo(f"{name:<24} {method.description}")


def _learning(
    steps: int | None, skill_steps: int | None, reward_margin_m: float | None, overrides: list[str] | None
) -> dict[str, Any]:
    """Settings of a trial about learning, defaults where left out."""
    from service.downstream.settings import validate
    from service.off_policy_config import SACConfig
    from service.parsing import ParseError, parse_yaml

    values = {}
    for override in overrides or []:
        key, separator, text = override.partition("=")
        if not separator or key not in SACConfig.model_fields:
            known = SACConfig.model_fields
            hint = did_you_mean(key, known)
            raise TandemError(f"--set {override}: write KEY=VALUE with KEY one of {', '.join(known)}{hint}")
        try:
            values[key] = parse_yaml(text, "its value")
        except ParseError as error:
            raise TandemError(f"--set {one_line(override, 200)}: the value is {error.reason}") from None
    chosen = {"num_env_steps": steps, "skill_steps": skill_steps, "reward_margin_m": reward_margin_m}
    return {"sac": validate(SACConfig, values), **{key: value for key, value in chosen.items() if value is not None}}


def _check_used(
    name: str, steps: int | None, skill_steps: int | None, reward_margin_m: float | None, overrides: list[str] | None
) -> None:
    """Refuse options that would do nothing for a method."""
    from service.downstream.methods import find_method

    method = find_method(name)
    if skill_steps is not None and method.takes != "skills":
        raise TandemError(f"--skill-steps is for methods that take skills, and {name} takes none: leave it out")
    learning = {"--steps": steps, "--reward-margin-m": reward_margin_m, "--set": overrides}
    typed = [option for option, value in learning.items() if value]
    if method.player is not None and typed:
        raise TandemError(f"{typed[0]} is about learning, and {name} learns nothing: leave it out")


def _names(text: str, known: Any) -> list[str]:
    return list(known) if text == "all" else [name.strip() for name in text.split(",")]


def _numbers(text: str) -> list[int]:
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in parts):
        raise TandemError(f"--seeds {text!r}: write numbers from 0 on with commas between, such as 0,1,2")
    return [int(part) for part in parts]


@contextmanager
def _make_runner(name: str, address: str | None, num_workers: int | None, threads: int | None) -> Iterator[Runner]:
    from service.downstream.table import run_here, run_on_ray

    if choose("--runtime", name, ("local", "ray")) == "local":
        for option, value in (("--address", address), ("--num-workers", num_workers)):
            if value is not None:
                raise TandemError(f"{option} needs --runtime ray")
        yield functools.partial(run_here, num_threads=threads or 0)
        return
    from service.runtime.ray_connection import connected

    with connected(address):
        yield functools.partial(run_on_ray, num_workers=num_workers, num_threads=threads or 1)


@contextmanager
def _stop_on_signals() -> Iterator[tuple[Callbacks, StopSignals]]:
    """Let SIGINT and SIGTERM end the block where it can be continued."""
    from service.downstream.worker import Callbacks
    from service.runs.signals import InterruptError, StopSignals

    stopping = functools.partial(answer, "stopping after this iteration; again to end now")
    with StopSignals() as signals, signals.asking(stopping):
        try:
            yield Callbacks(lambda: signals.first is not None, say=shown().say), signals
        except InterruptError as interrupt:  # a second one
            typer.echo("stopped at once; what came after the last checkpoint is lost", err=True)
            raise typer.Exit(EXIT_SIGNAL + interrupt.number) from None
