"""``tandem pretrain --seeds``: a study."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from service.cli.common import EXIT_SIGNAL, how_to_go_on, load_start, print_table, shown
from service.cli.unexpected import traceback_in
from service.errors import TandemError, one_line
from service.recipes import DEFAULT_RECIPE, recipes

if TYPE_CHECKING:
    from service.io.study_directory import StudyDirectory
    from service.runtime.pretrain_study import StudyResult
    from service.runtime.ray_connection import ClusterOptions

_NOTHING = "nothing was saved yet"
HEADER = ("seed", "state", "env steps", "minutes", "chosen by", "95 % interval", "mixed", "table", "air")


def is_study(run_dir: Path | None, seeds: str | None) -> bool:
    """Whether this is about a study: seeds are given, or the directory holds one."""
    from service.io.study_directory import is_study as holds_study

    return seeds is not None or (run_dir is not None and holds_study(run_dir))


def pretrain_study(
    path: Path | None,
    seeds: str | None,
    *,
    config: Path | None,
    overrides: list[str],
    runs: Path,
    registry: Path,
    resume: bool | None,
    publish: bool,
    parallel: int | None,
    cluster: Callable[[], ClusterOptions] | None,
    address: str | None,
    trackers: Sequence[str] = (),
    start_from: str | None = None,
) -> None:
    """Run a study and say what came out; exit code 1 where a run failed.

    Args:
        path: the study's directory; None: ``runs`` / its name.
        seeds: as typed; None to resume a study.
        config: YAML file; None: the shipped recipe, or what the study was begun with.
        overrides: of the configuration.
        runs: directory of run directories.
        registry: where the best run is published.
        resume: None: if the directory holds a study.
        publish: whether it is.
        parallel: how many runs at once.
        cluster: makes the options of each run on a Ray cluster; None: on this machine.
        address: of the cluster.
        trackers: of every run; see ``service.trackers``.
        start_from: as typed; what the runs of a new study begin from.
    """
    from service.config import load_config
    from service.io.study_directory import StudyDirectory
    from service.runs.resuming import resumed_config
    from service.runs.signals import InterruptError
    from service.runtime.pretrain_study import StudyCluster
    from service.runtime.pretrain_study import pretrain_study as run
    from service.runtime.progress import Progress
    from service.runtime.study_plan import check_same_seeds, parse_seeds

    given = parse_seeds(seeds) if seeds is not None else ()
    for override in overrides:
        if override.partition("=")[0].strip() == "seed":
            raise TandemError(f"--set {override}: the runs of a study have the seeds of --seeds; leave it out")
    if path is None:
        if resume:
            raise TandemError("--resume needs --run-dir, the directory of the study to continue")
        path = runs / load_config(config or recipes()[DEFAULT_RECIPE], overrides).name
    directory = StudyDirectory(path)
    resume = directory.exists if resume is None else resume
    if resume:
        resolved = resumed_config(directory, overrides, config)
        chosen = directory.read_seeds()
        if seeds is not None:
            check_same_seeds(given, chosen)
    else:
        if seeds is None:
            directory.check_free(())  # says that a study is there
        resolved, chosen = load_config(config or recipes()[DEFAULT_RECIPE], overrides), given
        directory.check_free(chosen)
        if start_from is not None:
            start_from = load_start(start_from, registry, resolved).reference
    options = cluster() if cluster is not None else None  # reads the status service's token
    connection: Any = nullcontext()
    if options is not None:
        from service.runtime.ray_connection import cluster_size, connected

        directory.claim()  # before Ray is started, which may take a minute
        connection = connected(address)
    hint = how_to_go_on(path, registry, runtime="ray" if options is not None else "local", address=address)
    try:
        with closing(directory), traceback_in(path), connection:
            place = StudyCluster(*cluster_size(address), options) if options is not None else None
            progress = Progress(resolved.run.total_env_steps, shown())
            result = run(
                resolved, directory, chosen, registry,
                resume=resume, publish=publish, parallel=parallel, cluster=place, progress=progress,
                trackers=trackers, start=start_from,
            )  # fmt: skip
    except InterruptError as interrupt:
        typer.echo(f"stopped at once; {hint if directory.exists else _NOTHING}")
        raise typer.Exit(EXIT_SIGNAL + interrupt.number) from None
    _print_result(result, directory, registry, hint)


def _print_result(result: StudyResult, directory: StudyDirectory, registry: Path, hint: str) -> None:
    failed = [run for run in result.runs if run.state == "failed"]
    if result.signal is None:
        _print_scores(result)
        if result.best is not None:
            typer.echo(f"best         seed {result.best}, chosen by goals other than those reported here")
        if result.picture is not None:
            typer.echo(f"curves       {result.picture}")
        typer.echo(f"results      {directory.results_file}")
        if result.version is not None:
            typer.echo(f"primitives   {result.version} in {registry}")
    for run in failed:
        typer.echo(one_line(f"seed {run.seed} failed: {run.error}"), err=True)
    if result.signal is not None:
        typer.echo(f"saved; {hint}")
        raise typer.Exit(EXIT_SIGNAL + result.signal)
    if not all(run.has_ended for run in result.runs):
        typer.echo(hint)
    if failed:
        raise typer.Exit(1)


def _print_scores(result: StudyResult) -> None:
    rows = []
    for run in result.runs:
        cells = [str(run.seed), run.state or "waiting", f"{run.num_env_steps:,}", f"{run.wall_s / 60:.1f}"]
        scores = result.scores.get(run.seed)
        if scores is not None:
            chosen = scores.selection
            reported = {each.goals: f"{each.success_last:.1%}" for each in scores.reported}
            cells += [f"{chosen.success_last:.1%}", f"{chosen.success_last_low:.1%} to {chosen.success_last_high:.1%}"]
            cells += [reported[kind] for kind in HEADER[-3:]]
        rows.append(cells + ["-"] * (len(HEADER) - len(cells)))
    print_table(HEADER, rows)
