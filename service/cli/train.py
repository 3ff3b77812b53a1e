"""``tandem train``, which ``tandem pretrain`` is, too."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from service.base.errors import TandemError
from service.cli.common import (
    REFERENCE,
    SOURCE,
    QuietOption,
    SourceOption,
    TrackerOption,
    choose,
    how_to_go_on,
    loading,
    shown,
    stopped,
    traceback_in,
    typed_options,
    was_typed,
)
from service.cli.study import is_study, train_study
from service.config import Config, load_config
from service.config.recipes import DEFAULT_RECIPE, recipes
from service.registry.token import read_token
from service.runs.named import named, targets
from service.runs.progress import Progress
from service.runs.resuming import resumed_config
from service.runs.signals import InterruptError
from service.runs.trackers import Trackers, find_factory
from service.store.models import RUN_ID
from service.store.run_directory import RunDirectory

if TYPE_CHECKING:
    from service.cluster.ray_connection import ClusterOptions
    from service.registry.loading import Trained
    from service.runs.run import Ending, OnIteration
    from service.runs.train import Finished

AUTO, EXACTLY = "auto", "exactly"
"""Values of ``--resume``; the second where it is typed alone."""
_OF_RAY, _OF_A_RUN_ON_RAY = ("address", "status", "token_file"), ("num_actors", "actor_threads", "learner_cpus")
"""Options that mean nothing in one process."""
_NOT_SAVED = ("publish", "parallel", "runtime", *_OF_RAY, *_OF_A_RUN_ON_RAY, "tracker")
"""Options that a resumed run has no file to read from."""


class TrainCommand(TyperCommand):
    """``tandem train``: the value of ``--resume`` can be left out, which typer does not have."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read what was typed after the command."""
        pairs = zip(args, [*args[1:], ""], strict=False)
        return super().parse_args(
            ctx, [f"--resume={EXACTLY}" if each == "--resume" and after != AUTO else each for each, after in pairs]
        )


def train(
    context: typer.Context,
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="RECIPE|TASK|FILE|all",
            autocompletion=targets,
            help="A recipe, a task such as push or of yours in FILE.py, or a YAML file; what it leaves "
            "out has its default. "
            f"Without: {DEFAULT_RECIPE}, or what a resumed run has. Several, such as push,wall, or all: a study.",
        ),
    ] = None,
    config: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", autocompletion=targets, help="The same, as an option."),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE.py:CLASS",
            help="Of a task: see tandem methods; several, or all: a study. Else lsd, dads, diayn, metra, csf.",
        ),
    ] = None,
    primitives: Annotated[
        str | None, typer.Option(metavar=REFERENCE, help="Of a task: the primitives or skills that its method takes.")
    ] = None,
    run_dir: Annotated[Path | None, typer.Option(metavar="DIR", help="Default: RUNS/NAME.")] = None,
    run_id: Annotated[
        str | None, typer.Option(metavar="ID", help="Run in RUNS/ID, and continue it if it has begun: for jobs.")
    ] = None,
    runs: Annotated[
        Path, typer.Option(envvar="TANDEM_RUNS", metavar="DIR", help="Directory of run directories.")
    ] = Path("runs"),
    resume: Annotated[
        str | None,
        typer.Option(metavar="[auto]", help="Continue the run in --run-dir exactly; auto: or begin it, for Slurm."),
    ] = None,
    start_from: Annotated[
        str | None,
        typer.Option("--from", metavar=REFERENCE, help="Begin with what that learned, as far as it fits."),
    ] = None,
    seeds: Annotated[
        str | None, typer.Option(metavar="0,1,2|0-4", help="A study: a run for each, in DIR/seed-N; names the best.")
    ] = None,
    grid: Annotated[
        list[str] | None,
        typer.Option(
            metavar="A.B=C,D",
            help="A study: a run for each value of a key; repeated: each combination.",
        ),
    ] = None,
    parallel: Annotated[
        int | None, typer.Option(help="Runs of a study at once; default: as many as there are cores for.", min=1)
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="A.B=C", help="Override a key of the configuration; repeatable."),
    ] = None,
    source: SourceOption = SOURCE,
    publish: Annotated[
        bool | None,
        typer.Option("--publish/--no-publish", help="Publish at the end. Default: all but policies of tasks."),
    ] = None,
    runtime: Annotated[str, typer.Option(help="local: in this process; ray: on a cluster.")] = "local",
    address: Annotated[
        str | None,
        typer.Option(metavar="auto|HOST:PORT", help="Ray cluster; default: the job's, or a new one on this machine."),
    ] = None,
    num_actors: Annotated[
        int | None, typer.Option(help="Rollout actors; default: as many as the cluster has cores for.", min=1)
    ] = None,
    actor_threads: Annotated[int, typer.Option(help="Cores of each rollout actor.", min=1)] = 1,
    learner_cpus: Annotated[
        float,
        typer.Option(help="Cores for the learner alone; 0: it shares those of the actors.", min=0),
    ] = 0.0,
    status: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT|off",
            help="Where the status service of a run on a cluster listens. "
            "Default: 127.0.0.1, at port 8321 or the next free one.",
        ),
    ] = None,
    token_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Its token; default: TANDEM_TOKEN. See tandem serve.")
    ] = None,
    tracker: TrackerOption = None,
    quiet: QuietOption = False,
) -> None:
    """Train what a recipe, a task or a file says, in this process or on a Ray cluster, and publish it."""

    def cluster_options() -> ClusterOptions:
        from service.cluster.ray_connection import ClusterOptions, parse_status

        where = parse_status(status, read_token(token_file))
        return ClusterOptions(num_actors, actor_threads, learner_cpus, where)

    if what is not None and config is not None:
        raise TandemError(f"{what} and --config {config}: name one of them")
    what, trackers, grid, overrides = what or config, tracker or [], grid or [], overrides or []
    for each in trackers:
        find_factory(each)  # now, not after Ray has started
    choose("--runtime", runtime, ("local", "ray"))
    again = resume is not None and choose("--resume", resume, (AUTO, EXACTLY)) == EXACTLY
    if run_id is not None:
        if re.fullmatch(RUN_ID, run_id) is None:
            raise TandemError(
                f"--run-id {run_id!r}: use 1 to 128 letters, digits, '.', '_' and '-', the first a letter or digit; "
                "for another place there is --run-dir"
            )
        run_dir, resume = runs / run_id, AUTO
    study = is_study(run_dir, seeds, grid, what, method)
    for is_so, names, why in (
        (runtime == "local", (*_OF_A_RUN_ON_RAY, *_OF_RAY), "is for a run on Ray: give --runtime ray, or leave it out"),
        (study, _OF_A_RUN_ON_RAY, "is for one run: --set run.num_threads=N says the cores of each run of a study"),
        (not study, ["parallel"], "is for the runs of a study: give --seeds or --grid, too, or leave it out"),
        (status == "off", ["token_file"], "is for the service that --status off leaves out: drop one of them"),
        (was_typed(context, "run_dir"), ["runs"], "is where --run-dir would be: drop one of them"),
        (run_id is not None, ["resume", "run_dir"], "is what --run-id says already: leave it out"),
        (again, ["from"], "is for a run that begins, and --resume goes on with one: leave out one of them"),
    ):
        for name in names:
            if is_so and was_typed(context, name):
                raise TandemError(f"--{name.replace('_', '-')} {why}")
    if again and run_dir is None:
        raise TandemError("--resume needs --run-dir, the directory of what is to be continued")
    typed = typed_options(context, _NOT_SAVED)
    if study:
        train_study(
            run_dir, what, method, primitives, seeds, grid,
            overrides=overrides, runs=runs, source=source, resume=None if resume == AUTO else again,
            publish=publish, parallel=parallel, cluster=cluster_options if runtime == "ray" else None, address=address,
            trackers=trackers, start_from=start_from, typed=typed,
        )  # fmt: skip
        return
    file, first = named(what, method, primitives)
    begun = file if file is not None or first else recipes()[DEFAULT_RECIPE]
    run_dir = run_dir or runs / load_config(begun, [*first, *overrides]).directory_name
    directory = RunDirectory(run_dir)
    if resume == AUTO:
        again = directory.exists
    start = None
    if again:
        _, said = named(what, method, primitives, resumed=True)
        resolved = resumed_config(directory, [*said, *overrides], file)
    else:
        with loading():
            from service.registry.loading import load

            start = load(start_from, source).expect("primitives", by="--from") if start_from is not None else None
            resolved = load_config(begun, [*first, *overrides]).begin(source, start)
    train_and_tell(
        resolved, directory, source, resume=again, publish=publish, start=start, trackers=trackers,
        cluster=cluster_options() if runtime == "ray" else None, address=address, typed=typed,
    )  # fmt: skip


def train_and_tell(
    config: Config,
    directory: RunDirectory,
    registry: Path | str,
    *,
    resume: bool,
    publish: bool | None = None,
    start: Trained | None = None,
    trackers: Sequence[str] = (),
    cluster: ClusterOptions | None = None,
    address: str | None = None,
    typed: Sequence[str] = (),
    until: OnIteration = lambda metrics: None,
) -> Finished:
    """Train, show how far that is, and say what came out, or how to go on.

    ``publish`` is None for all but policies of tasks; ``typed`` options belong to the command that goes on.
    """
    with loading():
        from service.runs import train as training
        from service.store.disk_reader import run_id_of

    runtime = training.Runtime()
    publish = config.publishable and config.makes != "orchestrator" if publish is None else publish
    hint, has_learned = how_to_go_on(directory.path, registry, typed), False
    try:
        with traceback_in(directory.path), closing(directory), ExitStack() as stack:
            if cluster is not None:
                from service.cluster.ray_connection import connected
                from service.cluster.ray_runtime import RayRuntime

                runtime = RayRuntime(cluster)
                training.prepare(config, directory, registry, resume=resume, publish=publish, runtime=runtime)
                stack.enter_context(connected(address))
            tree = config.model_dump(mode="json")
            tracked = stack.enter_context(closing(Trackers(trackers, run_id_of(directory.path), tree)))
            progress = stack.enter_context(closing(Progress(shown())))

            def tell(metrics: dict[str, float]) -> Ending | None:
                nonlocal has_learned
                has_learned = True
                progress.show(metrics, config.run.total_env_steps)
                tracked.log(metrics)
                return until(metrics)

            done = training.train(
                config, directory, registry,
                resume=resume, publish=publish, on_iteration=tell, runtime=runtime, start=start, options=typed,
            )  # fmt: skip
            if done.metrics:
                final = {f"final/{name.removeprefix('evaluation/')}": value for name, value in done.metrics.items()}
                tracked.log({"env_steps": done.num_env_steps, **final})
    except InterruptError as interrupt:
        raise stopped("stopped at once", interrupt.number, hint, begun=directory.exists) from None
    typer.echo(f"\n{done.reason} after {done.num_env_steps:,} env steps, {done.iteration} iterations")
    if resume and done.reason == "finished" and not has_learned:
        budget = f"{config.run.total_env_steps:,}"
        typer.echo(f"nothing was left to learn: run.total_env_steps is {budget}; raise it by --set to go on")
    typer.echo(done.timing)
    if done.signal is not None:
        rest = "" if done.reason == "interrupted" else ", but not evaluated, published and drawn to the end"
        raise stopped(f"saved{rest}", done.signal, hint)
    if done.reason == "interrupted":  # a stop request: somebody wanted this end, so it is none of the failures
        typer.echo(f"stopped on request and saved; {hint}")
    for name, value in done.metrics.items():
        is_share = "success" in name or name == "coverage"
        typer.echo(f"{name:<36} {value:.1%}" if is_share else f"{name:<36} {value:g}")
    for name, file in [*done.files.items(), ("checkpoint", directory.checkpoints)]:
        typer.echo(f"{name:<12} {file}")
    if done.version is not None:
        typer.echo(f"{config.makes:<12} {done.version} in {registry}")
    if done.metrics and config.makes == "orchestrator":
        typer.echo(f"try it:      tandem play {shlex.quote(str(directory.path))}")
    return done
