"""``tandem train`` with several seeds, tasks, methods or settings: a study."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from service.base.errors import ConfigError, TandemError, one_line
from service.cli.common import EXIT_SIGNAL, directory_of, how_to_go_on, load_start, loading, print_table, shown
from service.cli.unexpected import traceback_in
from service.config.recipes import DEFAULT_RECIPE, recipes
from service.runs.grid import SEED, Settings, check_once, name_runs, parse_grid

if TYPE_CHECKING:
    from service.cluster.ray_connection import ClusterOptions
    from service.config import Config
    from service.runs.signals import StopSignals
    from service.runs.study import Place
    from service.runs.study_file import StudyDirectory, StudyFile, StudyRun

NameOne = Callable[[str | None, str | None], tuple[Path | None, list[str]]]
"""The file and the overrides that a recipe, task or file and a method stand for."""
_MEASURED = ("success_last", "mixed_success_last", "table_success_last", "air_success_last", "coverage")


def is_study(run_dir: Path | None, seeds: str | None, grid: Sequence[str], *words: str | None) -> bool:
    """Whether this is about a study: seeds, a grid or several words are given, or the directory holds one."""
    from service.store.disk_reader import is_study as holds_study

    several = any(word == "all" or len(_words(word)) > 1 for word in words)
    return seeds is not None or bool(grid) or several or (run_dir is not None and holds_study(run_dir))


def train_study(
    run_dir: Path | None,
    what: str | None,
    method: str | None,
    seeds: str | None,
    grid: Sequence[str],
    *,
    name_one: NameOne,
    overrides: list[str],
    runs: Path,
    source: str,
    resume: bool | None,
    publish: bool | None,
    parallel: int | None,
    cluster: Callable[[], ClusterOptions] | None,
    address: str | None,
    trackers: Sequence[str] = (),
    start_from: str | None = None,
) -> None:
    """Run a study and say what came out; exit code 1 where a run failed.

    Args:
        run_dir: the study's directory; None: ``runs`` / its name.
        what: as typed: recipes, tasks or files, with commas between; None: the default recipe.
        method: as typed: methods, with commas between.
        seeds: as typed.
        grid: as typed.
        name_one: see ``NameOne``.
        overrides: of the configuration of every run.
        runs: directory of run directories.
        source: registry or its service.
        resume: None: if the directory holds a study.
        publish: whether the best run is published, if it can be; None: yes.
        parallel: how many runs at once.
        cluster: makes the options of a Ray cluster; None: on this machine.
        address: of the cluster.
        trackers: of every run; see ``service.runs.trackers``.
        start_from: as typed; what the runs of a new study begin from.
    """
    from service.registry.names import is_service
    from service.registry.registry import Registry
    from service.runs.progress import Progress
    from service.runs.signals import InterruptError, StopSignals
    from service.runs.study import Place, Study
    from service.runs.study_file import StudyDirectory

    for override in overrides:
        if (key := override.partition("=")[0].strip()) in {SEED, *parse_grid(grid)}:
            raise TandemError(f"--set {override}: each run has its own {key}, by --seeds or --grid; leave it out")
    if resume is None:
        resume = run_dir is not None and StudyDirectory(run_dir).exists
    planned = _plan(what, method, seeds, grid, name_one, None if resume else recipes()[DEFAULT_RECIPE])
    if resume:
        if run_dir is None:
            raise TandemError("--resume needs --run-dir, the directory of the study to continue")
        directory = StudyDirectory(run_dir)
        configs = _resumed(directory, planned, name_one(what, method) if not planned else (None, []), overrides)
    else:
        start = load_start(start_from, source) if start_from is not None else None
        new: dict[str, tuple[Settings, Config]] = {}
        with loading():
            from service.config import load_config

            for name, (settings, file, given) in planned.items():
                config = load_config(file, [*given, *overrides])
                new[name] = settings, config.begin(source, start)
        names = {config.name for _, config in new.values()}
        directory = StudyDirectory(run_dir or runs / (names.pop() if len(names) == 1 else "study"))
        directory.check_free(list(new))
        configs = {name: config for name, (_, config) in new.items()}
    registry = _registry(source, configs, publish)
    where = source if is_service(source) else str(Path(source).absolute())
    options = ["--registry", where, *(part for tracker in trackers for part in ("--tracker", tracker))]
    hint = how_to_go_on(directory.path, source, runtime="ray" if cluster is not None else "local", address=address)
    told = cluster() if cluster is not None else None  # reads the status service's token
    try:
        with closing(directory), traceback_in(directory.path), ExitStack() as stack:
            directory.claim()  # before Ray is started, which may take a minute
            place = _on_ray(stack, told, address, directory.path, source) if told is not None else Place()
            signals = stack.enter_context(StopSignals())
            if resume:
                for name, config in configs.items():
                    directory.write_config(name, config)
            else:
                directory.begin(new, start.reference if start is not None else None)
            most = max(config.run.total_env_steps for config in configs.values())
            progress = Progress(most, shown())
            study = Study(directory, progress)
            with progress:
                study.train(place, parallel, options, signals)
            if signals.first is None:
                study.finish(Registry(registry) if registry is not None else None)
    except InterruptError as interrupt:
        typer.echo(f"stopped at once; {hint if directory.exists else 'nothing was saved yet'}")
        raise typer.Exit(EXIT_SIGNAL + interrupt.number) from None
    _print(study.file, directory, registry, hint, signals)


def _words(text: str | None) -> list[str]:
    """Several names with commas between; a file's name may have one in it."""
    return [text] if text is not None and Path(text).exists() else [word.strip() for word in (text or "").split(",")]


def _plan(
    what: str | None,
    method: str | None,
    seeds: str | None,
    grid: Sequence[str],
    name_one: NameOne,
    default: Path | None,
) -> dict[str, tuple[Settings, Path | None, list[str]]]:
    """Settings, file and overrides of each run by its name; empty where nothing was given that makes several.

    ``default`` is the file of runs for which none is named.
    """
    from service.envs.tasks import HARD_TASKS, TASKS

    given = parse_grid(grid, seeds)
    whats, methods = _words(what), _words(method)
    whats = list(TASKS) if whats == ["all"] else whats
    methods = _all_methods() if methods == ["all"] else methods
    kind = "task" if {*whats} <= {*TASKS, *HARD_TASKS} else "recipe"
    several = {key: words for key, words in ((kind, whats), ("method", methods)) if len(words) > 1}
    for key, word, words in ((kind, what, whats), ("method", method, methods)):
        check_once(str(word), words)
        if word is not None and key in given:
            raise TandemError(f"{word} and --grid {key}={','.join(given[key])}: give one of them")
    planned = {}
    for name, settings in name_runs({**several, **given}).items():
        one, by = (settings[key] if key in several else word for key, word in ((kind, what), ("method", method)))
        file, overrides = name_one(one, by)
        if file is None and not overrides and "task" not in given:
            file = default
        planned[name] = settings, file, [*overrides, *(f"{key}={settings[key]}" for key in given)]
    return planned


def _all_methods() -> list[str]:
    """The methods of tasks that learn and take no skills: those are other commands, each with its own --primitives."""
    from service.config.find import METHODS as KNOWN
    from service.methods.task_methods import METHODS

    return [name for name, how in METHODS.items() if name in KNOWN and how.takes != "skills"]


def _resumed(
    directory: StudyDirectory,
    planned: dict[str, tuple[Settings, Path | None, list[str]]],
    named: tuple[Path | None, list[str]],
    overrides: list[str],
) -> dict[str, Config]:
    """The configurations to go on with.

    Raises:
        ConfigError: the study has other runs, or keeps what is to change.
    """
    from service.runs.resuming import resumed_config

    saved = directory.read().runs
    if planned and {name: settings for name, (settings, _, _) in planned.items()} != {
        name: run.settings for name, run in saved.items()
    }:
        raise ConfigError(
            f"the study in {directory.path} has the runs {_listed(saved)}, not {_listed(planned)}; leave out --seeds, "
            "--grid, tasks and methods to resume it, or begin another study with another --run-dir"
        )
    configs = {}
    for name in saved:
        _, file, given = planned.get(name, ({}, *named))
        known = [each for each in given if not each.startswith("primitives=")]  # an alias may have moved since
        configs[name] = resumed_config(directory.config(name), [*known, *overrides], file)
    return configs


def _listed(names: dict[str, StudyRun] | dict[str, tuple[Settings, Path | None, list[str]]]) -> str:
    return ", ".join(list(names)[:10]) + (", ..." if len(names) > 10 else "")


def _registry(source: str, configs: dict[str, Config], publish: bool | None) -> Path | None:
    """Where the best run is published; None: nowhere.

    Raises:
        TandemError: a registry that is only read, or nothing to be published.
    """
    from service.registry.registry import Registry

    if publish is False:
        return None
    if not any(config.makes == "primitives" for config in configs.values()):
        if publish:
            raise TandemError(
                "--publish: a study publishes the best of its runs that make primitives, and it has none of these; "
                "publish the run that you choose by tandem train --resume --publish --run-dir"
            )
        return None
    registry = directory_of(source, publish=True)
    Registry(registry).check_writable()  # now, not after hours of learning
    return registry


def _on_ray(stack: ExitStack, options: ClusterOptions, address: str | None, path: Path, source: str) -> Place:
    from service.cli.common import REGISTRY
    from service.cluster.ray_connection import connected
    from service.registry.names import is_service
    from service.store.address import address_from_environment

    stack.enter_context(connected(address))
    from service.cluster.ray_task import cluster_place
    from service.cluster.status_actor import serving

    if options.status is not None:
        registry = REGISTRY if is_service(source) else Path(source)
        url = stack.enter_context(serving(options.status, path.absolute().parent, registry, address_from_environment()))
        typer.echo(f"status: {url}", err=True)
    return cluster_place()


def _print(study: StudyFile, directory: StudyDirectory, registry: Path | None, hint: str, signals: StopSignals) -> None:
    from service.runs.study_results import measure_of, summaries

    failed = {name: run for name, run in study.runs.items() if run.state == "failed"}
    if signals.first is None:
        shown_here = [name for name in _MEASURED if any(name in run.result for run in study.runs.values())]
        rows = [
            [name, run.state, f"{run.env_steps:,}", f"{run.wall_s / 60:.1f}"]
            + [f"{run.result[key]:.1%}" if key in run.result else "-" for key in shown_here]
            for name, run in study.runs.items()
        ]
        print_table(("run", "state", "env steps", "minutes", *shown_here), rows)
        over = summaries(study.runs.values())
        if over:
            typer.echo("")
            keys = list(over[0][0])
            cells = []
            for settings, each in over:
                numbers = (str(each.num), f"{each.mean:.1%}", f"{each.iqm:.1%}", f"{each.low:.1%} to {each.high:.1%}")
                cells.append([*(settings[key] for key in keys), *numbers])
            print_table((*keys, f"runs of {measure_of(study.runs.values())}", "mean", "IQM", "95 % interval"), cells)
        if study.best is not None:
            typer.echo(f"best         {study.best}, chosen by goals other than those reported here")
        typer.echo(f"results      {directory.path / 'results.csv'}")
        if study.published is not None and registry is not None:
            typer.echo(f"primitives   {study.published} in {registry}")
    for name, run in failed.items():
        typer.echo(one_line(f"{name} failed: {run.error}"), err=True)
    if signals.first is not None:
        typer.echo(f"saved; {hint}")
        raise typer.Exit(EXIT_SIGNAL + signals.first)
    if not all(run.has_ended for run in study.runs.values()):
        typer.echo(hint)
    if failed:
        raise typer.Exit(1)
