"""A study from its first run to the published primitives of the best one."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

from service.config import Config
from service.errors import TandemError
from service.io.study_directory import StudyDirectory
from service.learner.learner import torch_device
from service.media.plots import plot_study
from service.progress import counted
from service.registry.names import Version
from service.registry.registry import Registry
from service.runs.signals import StopSignals
from service.runtime.progress import Progress
from service.runtime.ray_connection import ClusterOptions
from service.runtime.study import RunEnd, Study
from service.runtime.study_plan import share_cluster, share_machine
from service.runtime.study_results import Scores, best_seed, publish_best, score_run
from service.store.address import address_from_environment

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class StudyCluster:
    """The Ray cluster that the runs of a study share, and that this process is connected to."""

    address: str
    num_cores: float
    options: ClusterOptions
    """Options of each run, but for its status service, which is the study's."""


@dataclass(frozen=True, slots=True)
class StudyResult:
    """Results of a study."""

    runs: tuple[RunEnd, ...]
    scores: dict[int, Scores] = field(default_factory=dict)
    """By seed, of the runs that have ended."""
    best: int | None = None
    """Seed of the best run; None where no run has ended, or a signal came first."""
    version: Version | None = None
    """Version of its primitives."""
    picture: Path | None = None
    signal: int | None = None
    """Signal that ended it before its time."""


def pretrain_study(
    config: Config,
    directory: StudyDirectory,
    seeds: Sequence[int],
    registry: Path,
    *,
    resume: bool = False,
    publish: bool = True,
    parallel: int | None = None,
    cluster: StudyCluster | None = None,
    progress: Progress,
    trackers: Sequence[str] = (),
    start: str | None = None,
) -> StudyResult:
    """Run a run for every seed, each in a process of its own, then evaluate all, name the best and publish it.

    SIGINT and SIGTERM end all runs after their current iteration, saved; a second signal ends them at once.

    Args:
        config: of all runs, but for the seed.
        directory: where it keeps everything.
        seeds: of the runs.
        registry: where the best run is published; the others are not.
        resume: go on with the runs in the directory that have not ended, and begin those that are missing.
        publish: or else leave that to a later resume.
        parallel: how many runs at once; None: see ``share_machine`` and ``share_cluster``.
        cluster: run on it; None: on this machine, by the local runner.
        progress: where the runs are shown.
        trackers: of every run; see ``service.trackers``.
        start: reference of what the runs of a new study begin from (``Trained.reference``); one that is resumed knows.

    Raises:
        TandemError: see ``StudyDirectory``; a registry that is only read; or the best run cannot be published.
        InterruptError: a signal while the runs are evaluated, or a second one.
    """
    if publish:
        Registry(registry).check_writable()  # now, not after hours of learning
    if cluster is None:
        torch_device(config.learner.device)
    with StopSignals() as signals, ExitStack() as stack:
        stack.callback(directory.close)
        if resume:
            directory.resume(config)
        else:
            directory.begin(config, seeds, start)
        start = directory.read_start()
        study = Study(directory, seeds, config.run.total_env_steps, start)
        study.save()
        if cluster is not None and cluster.options.status is not None:
            from service.runtime.status_actor import serving

            runs_dir, redis = directory.path.absolute().parent, address_from_environment()
            url = stack.enter_context(serving(cluster.options.status, runs_dir, registry, redis))
            _logger.info("status: %s", url)
        if study.unfinished:
            num_parallel, place = _share(config, len(study.unfinished), parallel, cluster)
            place += [argument for tracker in trackers for argument in ("--tracker", tracker)]
            progress.say(f"runs to go: {len(study.unfinished)}, at once: {num_parallel}")
            with progress:
                first = ["--from", start, "--registry", str(registry)] if start is not None else []
                study.run(
                    lambda seed: _arguments(config, directory, seed, place, first), num_parallel, signals, progress
                )
        if signals.first is not None:
            return StudyResult(tuple(study.runs.values()), signal=signals.first)
        return _finish(study, directory, Registry(registry) if publish else None, progress)


def _share(config: Config, num_runs: int, parallel: int | None, cluster: StudyCluster | None) -> tuple[int, list[str]]:
    """Number of runs at once, and the arguments that tell each where it runs."""
    if cluster is None:
        share = share_machine(len(os.sched_getaffinity(0)), num_runs, parallel)
        chosen = config.run.num_threads or share.num_workers
        return share.num_parallel, ["--set", f"run.num_threads={chosen}"]
    options = cluster.options
    share = share_cluster(
        cluster.num_cores, num_runs, parallel,
        num_actors=options.num_actors, actor_threads=options.actor_threads, learner_cpus=options.learner_cpus,
    )  # fmt: skip
    place = ["--runtime", "ray", "--address", cluster.address, "--status", "off"]
    place += ["--num-actors", str(share.num_workers), "--actor-threads", str(options.actor_threads)]
    place += ["--learner-cpus", str(options.learner_cpus)]
    return share.num_parallel, place


def _arguments(
    config: Config, directory: StudyDirectory, seed: int, place: Sequence[str], first: Sequence[str] = ()
) -> list[str]:
    """The arguments of ``tandem`` that begin a run, then with ``first``, or go on with it; nothing is published yet."""
    run = directory.run(seed)
    arguments = ["pretrain", "--run-dir", str(run.path), "--no-publish"]
    if run.exists:
        arguments.append("--resume")
        for override in _resumable(config):
            arguments += ["--set", override]
    else:
        arguments += ["--config", str(directory.config_file), "--set", f"seed={seed}", *first]
    return [*arguments, *place]


def _resumable(config: Config) -> Iterator[str]:
    """All that may differ from what a run was begun with; see ``RESUMABLE``."""
    for key, value in config.run.model_dump(mode="json").items():
        yield f"run.{key}={json.dumps(value)}"
    for name, player in (("alice", config.learner.alice), ("bob", config.learner.bob)):
        yield f"learner.{name}.learning_rate={player.learning_rate!r}"


def _finish(study: Study, directory: StudyDirectory, registry: Registry | None, progress: Progress) -> StudyResult:
    """Score the runs that have ended, and publish the best of them."""
    ended = [run for run in study.runs.values() if run.has_ended]
    if ended:
        progress.say(f"learning is over; runs to evaluate: {len(ended)}")
    scores: dict[int, Scores] = {}
    for run in counted(ended, "evaluating the runs", len(ended), "runs"):
        try:
            scores[run.seed] = score_run(directory.run(run.seed))
        except TandemError as error:  # a damaged checkpoint
            study.runs[run.seed] = replace(run, state="failed", error=str(error))
    picture = _draw(directory, study)
    results = {"scores": {str(seed): each.as_dict() for seed, each in scores.items()}}
    if not scores:
        study.save(results)
        return StudyResult(tuple(study.runs.values()), picture=picture)
    best = best_seed(scores)
    study.save(results | {"best": {"seed": best}})  # known, whatever happens while it is published
    version = publish_best(directory, registry, study.runs[best], scores[best]) if registry is not None else None
    published = str(version) if version is not None else None
    study.save(results | {"best": {"seed": best, "published": published}})
    return StudyResult(tuple(study.runs.values()), scores, best, version, picture)


def _draw(directory: StudyDirectory, study: Study) -> Path | None:
    runs = {f"seed {seed}": directory.run(seed).path for seed in study.runs}
    try:
        return plot_study(runs, directory.path / "curves.png")
    except TandemError as error:
        _logger.warning("no curves: %s", error)
        return None
