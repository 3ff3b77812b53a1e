"""A pre-training run from the first signal handler to the published primitives."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from service.config import Config, load_config
from service.errors import ConfigError, TandemError
from service.io.run_directory import Published, RunDirectory
from service.io.study_directory import StudyDirectory
from service.learner.learner import torch_device
from service.media.artifacts import make_artifacts
from service.primitives.publishing import measure_bob, measure_skills, publish_run
from service.registry.names import Version
from service.registry.registry import Registry
from service.runtime.local import LocalRun, check_one_learner
from service.runtime.reporting import Report
from service.runtime.runner import OnIteration, Runner, RunResult, StateLostError
from service.runtime.signals import InterruptError, StopSignals
from service.store.address import address_from_environment
from service.store.disk_reader import run_id_of
from service.store.run_writer import RunWriter

if TYPE_CHECKING:
    from service.runtime.ray_connection import ClusterOptions
    from service.store.models import RunState

RESUMABLE = ("run.", "learner.num_learners=", "learner.alice.learning_rate=", "learner.bob.learning_rate=")
"""What an override of a resumed run may begin with: nothing that its past would have to be made again for."""
_NUM_LEARNERS = "learner.num_learners"
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Pretrained:
    """Results of a run."""

    result: RunResult
    files: dict[str, Path]
    """Pictures and video by what they show."""
    version: Version | None
    """Of the published primitives; None when interrupted, or when nothing was to be published."""
    metrics: dict[str, float]
    """Of the final evaluation."""
    timing: str
    """Where the time went, as a text tree."""
    signal: int | None = None
    """That ended it before its time."""


class UnfinishedError(TandemError):
    """Bob has learned and is saved, but could not be published."""

    exit_code = 1


def pretrain(
    config: Config,
    directory: RunDirectory,
    registry: Path,
    *,
    resume: bool = False,
    publish: bool = True,
    on_iteration: OnIteration,
    cluster: ClusterOptions | None = None,
) -> Pretrained:
    """Run to the end, then evaluate, publish, draw and record a video.

    SIGINT and SIGTERM end the run after the current iteration, saved, and what follows it at once: a resumed run does
    that again. A second signal ends an iteration, too. A stop request ends it as a signal does.

    Args:
        config: the run.
        directory: where it keeps everything.
        registry: where it publishes.
        resume: continue the run that the directory holds.
        publish: or else leave that to a later resume, or to ``publish_run``.
        on_iteration: called with the metrics of every iteration.
        cluster: run on the Ray cluster that this process is connected to; None: in this process.

    Raises:
        TandemError: see ``LocalRun``, ``ClusterRun`` and ``RunDirectory.start``; or a registry that is only read; or a
            Redis that is configured and cannot be used; or skill discovery on a cluster.
        UnfinishedError: everything is saved, and not published.
        InterruptError: a signal while the run was being loaded, or a second one.
    """
    runtime: Literal["local", "ray"] = "local" if cluster is None else "ray"
    with StopSignals() as signals, ExitStack() as stack:
        stack.callback(directory.close)
        last = prepare(config, directory, registry, resume=resume, publish=publish, runtime=runtime)
        run_id = run_id_of(directory.path)
        redis = address_from_environment()
        writer = RunWriter(directory.path, run_id, redis)
        published = last.version if last is not None else None
        report = stack.enter_context(Report(config, run_id, runtime, writer, published=published))
        if cluster is not None and cluster.status is not None:
            from service.runtime.status_actor import serving

            url = stack.enter_context(serving(cluster.status, directory.path.absolute().parent, registry, redis))
            _logger.info("status: %s/v1/runs/%s", url, run_id)
        if cluster is not None:
            from service.runtime.ray_connection import explaining_ray_errors

            stack.enter_context(explaining_ray_errors())  # before the report has them
        while True:
            with closing(_start(config, directory, cluster, resume=resume)) as run:
                try:
                    to = Registry(registry) if publish else None
                    done = _run(run, config, directory, to, signals, report, on_iteration)
                except StateLostError as error:  # with a machine of the cluster
                    _logger.warning("%s", error)
                    resume = True
                else:
                    return replace(done, signal=signals.first)


def prepare(
    config: Config, directory: RunDirectory, registry: Path, *, resume: bool, publish: bool, runtime: str
) -> Published | None:
    """Check what can be checked before Ray is started, which may take a minute, and keep other processes out.

    The caller closes the directory. A second call does nothing new.

    Returns:
        What the run published last.

    Raises:
        TandemError: see ``pretrain``.
    """
    if publish:
        Registry(registry).check_writable()  # now, not after hours of learning
    if runtime == "ray" and config.skills is not None:
        raise ConfigError(
            f"skills.method = {config.skills.method}: skill discovery runs in one process; use --runtime local"
        )
    if runtime == "local":  # on a cluster, another machine has it
        torch_device(config.learner.device)
        check_one_learner(config)
    directory.claim(resume=resume)
    return directory.read_published()


def _start(config: Config, directory: RunDirectory, cluster: ClusterOptions | None, *, resume: bool) -> Runner:
    if config.skills is not None:
        from service.runtime.skill_run import SkillRun

        return SkillRun(config, directory, resume=resume)
    if cluster is None:
        return LocalRun(config, directory, resume=resume)
    from service.runtime.cluster import ClusterRun  # where there is no cluster, Ray is not needed
    from service.runtime.ray_connection import started

    return started(lambda: ClusterRun(config, directory, cluster, resume=resume))


def _run(
    run: Runner,
    config: Config,
    directory: RunDirectory,
    registry: Registry | None,
    signals: StopSignals,
    report: Report,
    on_iteration: OnIteration,
) -> Pretrained:
    def beat() -> None:
        report.beat(run)
        if report.stop_requested():
            run.request_stop()

    def tell(metrics: dict[str, float]) -> None:
        on_iteration(metrics)
        report.iteration(run, metrics)
        if report.stop_requested():
            run.request_stop()

    report.begin(run)
    with signals.asking(run.request_stop):
        result = run.run(tell, beat)
    done = Pretrained(result, {}, None, {}, run.timing.tree(), signals.first)
    if result.reason != "interrupted" and signals.first is None:
        with suppress(InterruptError):
            done = _finish(done, config, directory, registry, run)
    complete = result.reason if signals.first is None else "interrupted"  # --resume does what is left
    report.end(cast("RunState", complete), published=str(done.version) if done.version is not None else None)
    return done


def _finish(
    done: Pretrained, config: Config, directory: RunDirectory, registry: Registry | None, run: Runner
) -> Pretrained:
    _logger.info("learning is over; now evaluating, publishing, drawing and recording a video")
    parameters = run.parameters()
    run.close()
    metrics, version = (measure_bob if config.skills is None else measure_skills)(config, parameters), None
    try:
        if registry is not None and (config.policy.monolithic_bob is None or config.skills is not None):
            known = metrics | {"env_steps": done.result.num_env_steps}
            version = publish_run(directory, registry, config, parameters, known)
    except TandemError as error:
        raise UnfinishedError(f"learning is over and saved, but not published: {error}; --resume does it") from error
    return replace(done, files=make_artifacts(directory), version=version, metrics=metrics, timing=run.timing.tree())


def resumed_config(directory: RunDirectory | StudyDirectory, overrides: list[str], file: Path | None = None) -> Config:
    """The configuration to resume a run with: the saved one, where only ``RESUMABLE`` may be changed.

    Args:
        directory: of the run, or of a study.
        overrides: ``run.a=b`` strings, or learning rates; others may only say what the run has.
        file: YAML that, with ``overrides``, says the same as the saved one outside ``run`` but for the number of
            learners; what it says there comes before ``overrides``.

    Raises:
        ConfigError: no run there, an override of anything else, or a file that says otherwise.
    """
    saved = directory.read_config()
    fixed = [override for override in overrides if not override.startswith(RESUMABLE)]
    for override in fixed:
        if not _says(saved, directory, override):
            raise ConfigError(
                f"override {override!r}: a resumed run keeps its configuration; only run.*, the learning rates and "
                "learner.num_learners may change, for example run.total_env_steps"
            )
    if file is not None:
        given = load_config(file, fixed, recorded=True)  # maybe the one the run was begun with, by an earlier version
        _check_same_outside_run(saved, given, file)
        named = given.run.model_dump(mode="json", exclude_unset=True)
        free = {f"run.{key}": value for key, value in named.items()}
        if _NUM_LEARNERS.rpartition(".")[2] in given.learner.model_fields_set:
            free[_NUM_LEARNERS] = given.learner.num_learners
        overrides = [f"{key}={json.dumps(value)}" for key, value in free.items()] + overrides
    return directory.read_config(overrides)


def _says(saved: Config, directory: RunDirectory | StudyDirectory, override: str) -> bool:
    try:
        return directory.read_config([override]) == saved
    except ConfigError:
        return False


def _check_same_outside_run(saved: Config, given: Config, file: Path) -> None:
    left, right = (dict(_leaves(config.model_dump(mode="json", exclude={"run"}))) for config in (saved, given))
    for key in sorted((left.keys() | right.keys()) - {_NUM_LEARNERS}):
        if left.get(key) != right.get(key):
            raise ConfigError(
                f"{file}: {key} = {right.get(key)!r}, but the run has {left.get(key)!r}; a resumed run keeps its "
                "configuration: leave out --config, or start another run without --resume"
            )


def _leaves(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value
