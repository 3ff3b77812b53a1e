"""A pre-training run from the first signal handler to the published primitives."""

from __future__ import annotations

import logging
import os
import socket
import sys
import time
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Literal, cast

from service.config import Config
from service.errors import ConfigError, TandemError
from service.io.checkpoints import CheckpointStore
from service.io.run_directory import Published, RunDirectory
from service.io.run_log import RunLog
from service.learner.learner import torch_device
from service.media.artifacts import make_artifacts
from service.primitives.publishing import measure_bob, measure_skills, publish_run
from service.progress import answer, doing
from service.registry.names import Version
from service.registry.registry import Registry
from service.runtime.local import LocalRun, check_one_learner
from service.runtime.reporting import Report
from service.runtime.runner import ClusterError, OnIteration, Runner, RunResult, StateLostError
from service.runtime.signals import InterruptError, StopSignals
from service.store.address import address_from_environment
from service.store.disk import read_status
from service.store.disk_reader import run_id_of
from service.store.run_writer import RunWriter

if TYPE_CHECKING:
    from service.runtime.ray_connection import ClusterOptions
    from service.runtime.raylet import RayletWatch
    from service.runtime.starting import Start
    from service.store.models import RunState

MAX_STATES_LOST = 5
"""Times in a row that a run goes back to a checkpoint without getting beyond it."""
BACK_OFF_S = 2.0
"""Pause before the second time; it doubles."""
END_S = 5.0
"""Most time to tell how a run ended whose process is ended at once."""
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
    start: Start | None = None,
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
        start: what a new run begins from (``starting.read_start``); a resumed one has begun already.

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
        previous = read_status(directory.path) if resume else None
        writer = RunWriter(directory, run_id, redis)
        published = last.version if last is not None else None
        assert directory.epoch is not None
        epoch = directory.epoch.number
        report = Report(config, run_id, runtime, writer, published=published, previous=previous, epoch=epoch)
        log = stack.enter_context(RunLog(directory.path))
        begins = "goes on with" if resume else "begins"
        log.note(f"process {os.getpid()} on {socket.gethostname()} {begins} the run ({runtime} runtime)")
        stack.enter_context(report)
        raylet = None
        if cluster is not None:
            from service.runtime.ray_connection import explaining_ray_errors
            from service.runtime.raylet import RayletWatch

            stack.enter_context(explaining_ray_errors())  # before the report has them
            raylet = stack.enter_context(RayletWatch(lambda what: _end_now(report, directory, what)))
        if cluster is not None and cluster.status is not None:
            from service.runtime.status_actor import serving

            url = stack.enter_context(serving(cluster.status, directory.path.absolute().parent, registry, redis))
            _logger.info("status: %s/v1/runs/%s", url, run_id)
        num_lost, furthest = 0, -1
        while True:
            with doing("starting", aloud=False):
                started = _start(config, directory, cluster, raylet, resume=resume, start=start)
            with closing(started) as run:
                try:
                    to = Registry(registry) if publish else None
                    done = _run(run, config, directory, to, signals, report, on_iteration)
                except StateLostError as error:  # with a machine of the cluster
                    num_lost = num_lost + 1 if run.iteration <= furthest else 1
                    furthest = max(furthest, run.iteration)
                    if num_lost >= MAX_STATES_LOST:
                        raise
                    _logger.warning("%s", error)
                    resume = True
                else:
                    said = f", published {done.version}" if done.version is not None else ""
                    at = f"iteration {done.result.iteration}, {done.result.num_env_steps} env steps"
                    log.note(f"the run is {done.result.reason} at {at}{said}")
                    return replace(done, signal=signals.first)
            time.sleep(BACK_OFF_S * (2 ** (num_lost - 1) - 1))


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
    if runtime == "ray" and config.distillation is not None:
        raise ConfigError("distillation runs in one process: use --runtime local, or leave out distillation")
    if runtime == "local":  # on a cluster, another machine has it
        torch_device(config.learner.device)
        check_one_learner(config)
    directory.claim(resume=resume)
    return directory.read_published()


def _start(
    config: Config,
    directory: RunDirectory,
    cluster: ClusterOptions | None,
    raylet: RayletWatch | None,
    *,
    resume: bool,
    start: Start | None,
) -> Runner:
    if config.skills is not None:
        from service.runtime.skill_run import SkillRun

        return SkillRun(config, directory, resume=resume)
    if config.distillation is not None:
        from service.runtime.distillation_run import DistillationRun

        return DistillationRun(config, directory, resume=resume, start=start)
    if cluster is None:
        return LocalRun(config, directory, resume=resume, start=start)
    from service.runtime.cluster import ClusterRun  # where there is no cluster, Ray is not needed

    if (
        start is not None and not resume
    ):  # the first checkpoint says what there is to begin from, and both runners read it
        one = config.learner.model_copy(update={"num_learners": 1, "device": "cpu"})
        LocalRun(config.model_copy(update={"learner": one}), directory, start=start).close()
        resume = True
    return ClusterRun(config, directory, cluster, resume=resume, raylet=raylet)


def _end_now(report: Report, directory: RunDirectory, what: str) -> None:
    """End this process from a thread while Ray is frozen: no call of the main thread may ever come back."""
    try:
        saved = next(reversed(CheckpointStore(directory.checkpoints, keep=1).steps()), None)
        text = f"{what}; " + ("nothing is saved yet" if saved is None else f"--resume goes on from iteration {saved}")
        print(f"error: {text}", file=sys.stderr, flush=True)
        ending = Thread(target=report.__exit__, args=(ClusterError, ClusterError(text), None), daemon=True)
        ending.start()
        ending.join(END_S)  # a disk or a Redis may stand still, too
    finally:
        os._exit(ClusterError.exit_code)


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

    def stop() -> None:
        run.request_stop()
        answer("stopping after this iteration; again to end now")

    with signals.asking(stop):
        result = run.run(tell, beat)
    done = Pretrained(result, {}, None, {}, run.timing.tree(), signals.first)
    if result.reason != "interrupted" and signals.first is None:
        with suppress(InterruptError), report.beating():
            done = _finish(done, config, directory, registry, run, report)
    complete = result.reason if signals.first is None else "interrupted"  # --resume does what is left
    report.end(cast("RunState", complete), published=str(done.version) if done.version is not None else None)
    return done


def _finish(
    done: Pretrained, config: Config, directory: RunDirectory, registry: Registry | None, run: Runner, report: Report
) -> Pretrained:
    _logger.info("learning is over; now evaluating, publishing, drawing and recording a video")
    parameters = run.parameters()
    run.close()
    metrics, version = (measure_bob if config.skills is None else measure_skills)(config, parameters), None
    report.check()
    try:
        if registry is not None and (config.policy.monolithic_bob is None or config.skills is not None):
            known = metrics | {"env_steps": done.result.num_env_steps}
            version = publish_run(directory, registry, config, parameters, known)
    except TandemError as error:
        raise UnfinishedError(f"learning is over and saved, but not published: {error}; --resume does it") from error
    report.check()
    return replace(done, files=make_artifacts(directory), version=version, metrics=metrics, timing=run.timing.tree())
