"""``tandem train`` with several seeds, tasks, methods or settings: a study."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from service.base.errors import ConfigError, TandemError, one_line
from service.cli.common import REGISTRY, how_to_go_on, loading, print_table, shown, stopped, traceback_in
from service.config import Config, load_config
from service.config.find import METHODS
from service.config.recipes import DEFAULT_RECIPE, recipes
from service.config.task_methods import TASK_METHODS
from service.envs.tasks import PAPERS
from service.registry.names import is_service
from service.runs.grid import SEED, Settings, check_once, name_runs, parse_grid
from service.runs.named import is_task, named
from service.runs.progress import Progress
from service.runs.resuming import resumed_config
from service.runs.signals import InterruptError, StopSignals
from service.runs.study_run import Place
from service.store.address import address_from_environment

if TYPE_CHECKING:
    from service.cluster.ray_connection import ClusterOptions
    from service.runs.study import Study, StudyFile

Planned = dict[str, tuple[Settings, Path | None, list[str]]]
"""By the name of a run its settings, the file of its configuration, and what is changed in that."""
_MEASURED = (
    "success_last",
    "mixed_success_last",
    "table_success_last",
    "air_success_last",
    "one_success_last",
    "coverage",
)


def is_study(run_dir: Path | None, seeds: str | None, grid: Sequence[str], *words: str | None) -> bool:
    """Whether this is about a study: seeds, a grid or several words are given, or the directory holds one."""
    from service.store.disk_reader import is_study as holds_study

    several = any(word == "all" or len(_words(word)) > 1 for word in words)
    return seeds is not None or bool(grid) or several or (run_dir is not None and holds_study(run_dir))


def train_study(
    run_dir: Path | None,
    what: str | None,
    method: str | None,
    primitives: str | None,
    seeds: str | None,
    grid: Sequence[str],
    *,
    overrides: list[str],
    runs: Path,
    source: str,
    resume: bool | None,
    publish: bool | None,
    parallel: int | None,
    cluster: Callable[[], ClusterOptions] | None,
    address: str | None,
    trackers: Sequence[str],
    start_from: str | None,
    typed: Sequence[str],
) -> None:
    """Run a study and say what came out; exit code 1 where a run failed.

    Args:
        run_dir: the study's directory; None: ``runs`` / its name.
        what: as typed: recipes, tasks or files, with commas between; None: the default recipe.
        method: as typed: methods, with commas between.
        primitives: as typed.
        seeds: as typed.
        grid: as typed.
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
        typed: options of the command that goes on.
    """
    from service.registry.loading import load
    from service.runs.study import Study

    for override in overrides:
        if (key := override.partition("=")[0].strip()) in {SEED, *parse_grid(grid)}:
            raise TandemError(f"--set {override}: each run has its own {key}, by --seeds or --grid; leave it out")
    if resume is None:
        resume = run_dir is not None and Study(run_dir).exists
    planned = _plan(what, method, primitives, seeds, grid, None if resume else recipes()[DEFAULT_RECIPE])
    start = None
    if resume:
        assert run_dir is not None, "checked"
        study = Study(run_dir)
        configs = _resumed(study, planned, (None, []) if planned else named(what, method, primitives), overrides)
    else:
        start = load(start_from, source).expect("primitives", by="--from") if start_from is not None else None
        with loading():
            configs = {
                name: load_config(file, [*given, *overrides]).begin(source, start)
                for name, (_, file, given) in planned.items()
            }
        names = {config.name for config in configs.values()}
        study = Study(run_dir or runs / (names.pop() if len(names) == 1 else "study"))
        study.check_free(configs)
    registry = _registry(source, configs.values(), publish)
    where = source if is_service(source) else str(Path(source).absolute())
    options = ["--registry", where, *(part for tracker in trackers for part in ("--tracker", tracker))]
    hint = how_to_go_on(study.path, source, typed)
    told = cluster() if cluster is not None else None  # reads the status service's token
    try:
        with closing(study), traceback_in(study.path), ExitStack() as stack:
            study.claim()  # before Ray is started, which may take a minute
            place = _on_ray(stack, told, address, study.path, source) if told is not None else Place()
            signals = stack.enter_context(StopSignals())
            if resume:
                study.write_configs(configs)
            else:
                settings = {name: each for name, (each, _, _) in planned.items()}
                study.begin(settings, configs, start.reference if start is not None else None)
            with closing(Progress(shown())) as progress:
                study.train(configs, place, parallel, options, signals, progress, typed)
                if signals.first is None:
                    study.finish(configs, registry, progress)
    except InterruptError as interrupt:
        raise stopped("stopped at once", interrupt.number, hint, begun=study.exists) from None
    found = study.read()
    if signals.first is None:
        _print(found, study.path, registry)
    failed = {name: run for name, run in found.runs.items() if run.state == "failed"}
    for name, run in failed.items():
        typer.echo(one_line(f"{name} failed: {run.error}"), err=True)
    if signals.first is not None:
        raise stopped("saved", signals.first, hint)
    if not all(run.has_ended for run in found.runs.values()):
        typer.echo(hint)
    if failed:
        raise typer.Exit(1)


def _words(text: str | None) -> list[str]:
    """Several names with commas between; a file's name may have one in it."""
    return [text] if text is not None and Path(text).exists() else [word.strip() for word in (text or "").split(",")]


def _plan(
    what: str | None,
    method: str | None,
    primitives: str | None,
    seeds: str | None,
    grid: Sequence[str],
    default: Path | None,
) -> Planned:
    """The runs that were typed; none where nothing was that makes several.

    ``default`` is the file of runs for which none is named.
    """
    given = parse_grid(grid, seeds)
    whats, methods = _words(what), _words(method)
    whats = list(PAPERS) if whats == ["all"] else whats
    if methods == ["all"]:  # skills are other commands, each with its own --primitives
        methods = [name for name, how in TASK_METHODS.items() if name in METHODS and how.takes != "skills"]
    kind = "task" if all(map(is_task, whats)) else "recipe"
    several = {key: words for key, words in ((kind, whats), ("method", methods)) if len(words) > 1}
    for key, word, words in ((kind, what, whats), ("method", method, methods)):
        check_once(str(word), words)
        if word is not None and key in given:
            raise TandemError(f"{word} and --grid {key}={','.join(given[key])}: give one of them")
    planned: Planned = {}
    for name, settings in name_runs({**several, **given}).items():
        one, by = (settings[key] if key in several else word for key, word in ((kind, what), ("method", method)))
        file, overrides = named(one, by, primitives)
        if file is None and not overrides and "task" not in given:
            file = default
        planned[name] = settings, file, [*overrides, *(f"{key}={settings[key]}" for key in given)]
    return planned


def _resumed(
    study: Study, planned: Planned, typed: tuple[Path | None, list[str]], overrides: list[str]
) -> dict[str, Config]:
    """The configurations to go on with.

    Raises:
        ConfigError: the study has other runs, or keeps what is to change.
    """
    saved = study.read().runs
    if planned and {name: each for name, (each, _, _) in planned.items()} != {
        name: run.settings for name, run in saved.items()
    }:
        raise ConfigError(
            f"the study in {study.path} has the runs {_listed(saved)}, not {_listed(planned)}; leave out --seeds, "
            "--grid, tasks and methods to resume it, or begin another study with another --run-dir"
        )
    configs = {}
    for name in saved:
        _, file, given = planned.get(name, ({}, *typed))
        configs[name] = resumed_config(study.config_file(name), [*given, *overrides], file)
    return configs


def _listed(names: Iterable[str]) -> str:
    first, *more = [", ".join(part) for part in (list(names)[:10], list(names)[10:]) if part]
    return first + (", ..." if more else "")


def _registry(source: str, configs: Iterable[Config], publish: bool | None) -> Path | None:
    """Where the best run is published; None: nowhere.

    Raises:
        TandemError: a registry that is only read, or nothing to be published.
    """
    from service.registry.publishing import check_publishable

    if publish is False:
        return None
    best = {config.name: config for config in configs if config.makes == "primitives" and config.publishable}
    if publish and not best:
        raise TandemError(
            "--publish: a study publishes the best of its runs that make primitives, and it has none of these; "
            "publish the run that you choose by tandem train --resume --publish --run-dir"
        )
    for config in best.values():
        check_publishable(config, source)  # now, not after hours of learning
    return Path(source) if best else None


def _on_ray(stack: ExitStack, options: ClusterOptions, address: str | None, path: Path, source: str) -> Place:
    from service.cluster.ray_connection import connected

    stack.enter_context(connected(address))
    from service.cluster.ray_task import cluster_place
    from service.cluster.status_actor import serving

    if options.status is not None:
        registry = REGISTRY if is_service(source) else Path(source)
        url = stack.enter_context(serving(options.status, path.absolute().parent, registry, address_from_environment()))
        typer.echo(f"status: {url}", err=True)
    return cluster_place()


def _print(study: StudyFile, path: Path, registry: Path | None) -> None:
    """Print a line for each run, one for all that differ in nothing but their seed, and where everything is."""
    from service.runs.study_results import MEASURES, measure_of, summaries

    runs, measure = study.runs.values(), measure_of(study.runs.values())
    measured = [name for name in _MEASURED if any(name in run.result for run in runs)]
    if measure is not None and not measured:
        measured = [measure]
    form = ".1%" if measure in MEASURES else ".4g"  # what a method of a user's measures may be anything
    rows = [
        [name, run.state, f"{run.env_steps:,}", f"{run.wall_s / 60:.1f}"]
        + [f"{run.result[key]:{form}}" if key in run.result else "-" for key in measured]
        for name, run in study.runs.items()
    ]
    print_table(("run", "state", "env steps", "minutes", *measured), rows)
    if over := summaries(runs):
        typer.echo("")
        rows = [
            [
                *settings.values(),
                str(each.num),
                f"{each.mean:{form}}",
                f"{each.iqm:{form}}",
                f"{each.low:{form}} to {each.high:{form}}" if each.num > 1 else "-",
            ]
            for settings, each in over
        ]
        print_table((*over[0][0], f"runs of {measure}", "mean", "IQM", "95 % interval"), rows)
    if study.best is not None:
        typer.echo(f"best         {study.best}, chosen by goals other than those reported here")
    typer.echo(f"results      {path / 'results.csv'}")
    if study.published is not None and registry is not None:
        typer.echo(f"primitives   {study.published} in {registry}")
