"""A training from the first signal handler to what it publishes; and publishing by hand what a run has learned."""

from __future__ import annotations

import logging
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Literal, cast

from pydantic import JsonValue

from service.base.errors import TandemError
from service.base.jsonl import plain
from service.base.progress import answer, doing
from service.base.types import Metrics
from service.base.user_code import changed_since
from service.config import Config
from service.config.skills import SkillDiscoveryConfig
from service.config.task import TaskConfig
from service.envs.tasks import find_task
from service.media.artifacts import make_artifacts
from service.methods.method import Method, StateLostError, WorkersError
from service.methods.task_evaluation import FINAL_SEED, evaluate_on, numbers_of
from service.registry.loading import Trained, load
from service.registry.names import Version, check_name, is_service
from service.registry.publishing import check_makes, check_publishable, measure_bob, measure_skills, publish_run
from service.registry.registry import Registry
from service.runs.report import Report
from service.runs.run import Ending, OnBeat, OnIteration, Run
from service.runs.signals import InterruptError, StopSignals
from service.store.address import address_from_environment
from service.store.checkpoints import CheckpointStore
from service.store.disk_reader import run_id_of
from service.store.models import ACTIVE, RunState, read_status
from service.store.run_directory import Published, RunDirectory
from service.store.run_log import logging_to
from service.store.run_writer import RunWriter, reporting_to

MAX_STATES_LOST = 5
"""Times in a row that a run goes back to a checkpoint without getting beyond it."""
BACK_OFF_S = 2.0
"""The pauses from the second time on are this, then three and seven times as long."""
END_S = 5.0
"""Most time to tell how a run ended whose process is ended at once."""
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Finished:
    """Results of a training."""

    reason: str
    """``finished``, ``converged`` or ``interrupted``; see ``Run.run``."""
    iteration: int
    num_env_steps: int
    timing: str
    """Where the time went, as a text tree."""
    files: dict[str, Path] = field(default_factory=dict)
    """Pictures and video by what they show."""
    version: Version | None = None
    """What it published; None when interrupted, or when nothing was to be published."""
    metrics: dict[str, float] = field(default_factory=dict)
    """Metrics of the final evaluation."""
    signal: int | None = None
    """The signal that ended it before its time."""


class UnfinishedError(TandemError):
    """What was learned is saved, but could not be published."""

    exit_code = 1


class Runtime:
    """Where a method's workers are: in this process. See ``service.cluster.ray_runtime`` for a cluster."""

    name: Literal["local", "ray"] = "local"

    def check(self, config: Config) -> None:
        """Check that the method can be here.

        Raises:
            TandemError: it cannot.
        """
        config.check_here()

    def make(self, config: Config, registry: Path | str, start_from: Trained | None) -> Method:
        """Make the method of a run, which begins from ``start_from`` where there is one."""
        method: Method = config.build(registry, start_from)
        return method

    @contextmanager
    def around(self, directory: Path, registry: Path, end_now: Callable[[str], None]) -> Iterator[None]:
        """Surround a run with what it needs, such as a watch that may call ``end_now`` with a reason."""
        yield


def train(
    config: Config,
    directory: RunDirectory,
    registry: Path | str,
    *,
    resume: bool = False,
    publish: bool = True,
    on_iteration: OnIteration,
    runtime: Runtime | None = None,
    start: Trained | None = None,
    options: Sequence[str] = (),
) -> Finished:
    """Train to the end, then evaluate, publish, draw and record a video.

    SIGINT, SIGTERM and SIGHUP end the run after the current iteration, saved, and what follows it at once: a resumed
    run does that again. A second signal ends an iteration, too. A stop request ends it as a signal does.

    Args:
        config: the run.
        directory: where it keeps everything.
        registry: directory where it publishes; what the method takes is looked up there, too.
        resume: continue the run that the directory holds.
        publish: or else leave that to a later resume, or to ``publish_run``.
        on_iteration: called with the metrics of every iteration; what it returns, if anything, ends the run.
        runtime: where its workers are; None: in this process.
        start: what a new run begins from (``service.load``); a resumed one has begun already.
        options: of the command that goes on with it, besides directory and registry, for the page.

    Raises:
        TandemError: see ``Run`` and ``RunDirectory.start``; or a registry that is only read; or of a new run a Redis
            that is configured and cannot be used; or a method that the runtime does not have.
        UnfinishedError: everything is saved, and not published.
        InterruptError: a signal while the run was being loaded, or a second one.
    """
    runtime = runtime or Runtime()
    with StopSignals() as signals, ExitStack() as stack:
        stack.callback(directory.close)
        last = prepare(config, directory, registry, resume=resume, publish=publish, runtime=runtime)
        for origin in changed_since(config.code):
            _logger.warning(
                "%s has another text by now than the configuration of this run, which runs with its own", origin
            )
        run_id = run_id_of(directory.path)
        previous = read_status(directory.path) if resume else None
        writer = reporting_to(directory, run_id, address_from_environment(), resumed=resume)
        published, epoch = last.version if last is not None else None, directory.epoch
        report = Report(
            config, run_id, runtime.name, writer,
            published=published, previous=previous, identity=directory.history.run, epoch=epoch, options=options,
        )  # fmt: skip
        log = stack.enter_context(logging_to(directory.path))
        begins = "goes on with" if resume else "begins"
        log(f"process {os.getpid()} on {socket.gethostname()} {begins} the run ({runtime.name} runtime)")
        stack.enter_context(report)
        served = Path("registry") if is_service(registry) else Path(registry)
        stack.enter_context(runtime.around(directory.path, served, partial(_end_now, report, directory)))
        num_lost, furthest = 0, -1
        while True:
            reached = -1
            try:
                with doing("starting", aloud=False):
                    begun = open_run(
                        config, directory, registry, resume=resume, start=start, runtime=runtime, on_beat=report.alive
                    )
                with closing(begun) as run:
                    try:
                        done = _run(run, registry, publish, signals, report, on_iteration)
                    finally:
                        reached = run.iteration
            except StateLostError as error:  # with a machine of the cluster
                num_lost = num_lost + 1 if reached <= furthest else 1
                furthest = max(furthest, reached)
                if num_lost >= MAX_STATES_LOST:
                    raise
                _logger.warning("%s", error)
                resume = directory.exists
            else:
                said = f", published {done.version}" if done.version is not None else ""
                at = f"iteration {done.iteration}, {done.num_env_steps} env steps"
                log(f"the run is {done.reason} at {at}{said}")
                return done
            time.sleep(BACK_OFF_S * (2 ** (num_lost - 1) - 1))


def open_run(
    config: Config,
    directory: RunDirectory,
    registry: Path | str = "registry",
    *,
    resume: bool = False,
    start: Trained | None = None,
    runtime: Runtime | None = None,
    on_beat: OnBeat = lambda: None,
) -> Run:
    """Begin or continue a run, of which nothing is reported; see ``train`` and ``Run``."""
    make = partial((runtime or Runtime()).make, config, registry, start)
    parent = start.published if start is not None else None
    return Run(config, directory, make, resume=resume, parent=parent, on_beat=on_beat)


def prepare(
    config: Config, directory: RunDirectory, registry: Path | str, *, resume: bool, publish: bool, runtime: Runtime
) -> Published | None:
    """Check what can be checked before Ray is started, which may take a minute, and keep other processes out.

    The caller closes the directory. A second call does nothing new.

    Returns:
        What the run published last.

    Raises:
        TandemError: see ``train``.
    """
    if publish:
        check_publishable(config, registry)  # now, not after hours of learning
    runtime.check(config)
    directory.claim(resume=resume)
    return directory.read_published()


def _end_now(report: Report, directory: RunDirectory, what: str) -> None:
    """End this process from a thread while Ray is frozen: no call of the main thread may ever come back."""
    try:
        saved = next(reversed(CheckpointStore(directory.checkpoints).steps()), None)
        text = f"{what}; " + ("nothing is saved yet" if saved is None else f"--resume goes on from iteration {saved}")
        with suppress(OSError):  # a full disk, or a terminal that is gone
            print(f"error: {text}", file=sys.stderr, flush=True)
        ending = Thread(target=report.__exit__, args=(WorkersError, WorkersError(text), None), daemon=True)
        ending.start()
        ending.join(END_S)  # a disk or a Redis may stand still, too
    finally:
        os._exit(WorkersError.exit_code)


def _run(
    run: Run, registry: Path | str, publish: bool, signals: StopSignals, report: Report, on_iteration: OnIteration
) -> Finished:
    def tell(metrics: dict[str, float]) -> Ending | None:
        ending = on_iteration(metrics)
        report.iteration(run, metrics)
        return ending

    def stop() -> None:
        run.request_stop()
        answer("stopping after this iteration; again to end now")

    report.begin(run)
    with signals.asking(stop), report.beating(run.directory):
        reason = run.run(tell, partial(report.beat, run))
    done = Finished(reason, run.iteration, run.num_env_steps, run.method.timing.tree())
    if reason != "interrupted" and signals.first is None:
        with suppress(InterruptError), report.beating(run.directory):
            done = _finish(done, run, registry, publish, report)
    complete = reason if signals.first is None else "interrupted"  # --resume does what is left
    report.end(cast(RunState, complete), published=str(done.version) if done.version is not None else None)
    return replace(done, signal=signals.first)


def _finish(done: Finished, run: Run, registry: Path | str, publish: bool, report: Report) -> Finished:
    publishing = "publishing, " * publish
    drawing = f", {publishing}drawing and recording a video" if run.config.makes is not None else ""
    _logger.info("learning is over; now evaluating%s", drawing)
    config, directory = run.config, run.directory
    with run.naming_errors():
        parameters, measured = run.parameters(), dict(run.numbers("measure", run.method.measure()))
    # a method of a user's may give numbers of NumPy's, and such as are none
    metrics = {name: value for name, value in plain(measured).items() if value is not None}
    if missing := measured.keys() - metrics.keys():
        _logger.warning("measured, and no finite number: %s", ", ".join(sorted(missing)))
    version = None
    directory.check_owner()
    short = {name: name.removeprefix("evaluation/") for name in metrics}
    found: dict[str, JsonValue] = {
        name if short[name] != name and short[name] in metrics else short[name]: value
        for name, value in metrics.items()
    }
    directory.write_result({"evaluation": found, "env_steps": run.num_env_steps, "wall_s": run.wall_s})
    run.close()
    report.measured(metrics)
    try:
        if publish:
            known = metrics | {"env_steps": done.num_env_steps}
            version = publish_run(directory, Registry(Path(registry)), config, parameters, known)
    except TandemError as error:
        raise UnfinishedError(f"learning is over and saved, but not published: {error}; --resume does it") from error
    directory.check_owner()
    files, timing = make_artifacts(directory, registry), run.method.timing.tree()
    return replace(done, files=files, version=version, metrics=metrics, timing=timing)


def publish_learned(
    path: Path,
    registry: Path | str,
    name: str | None = None,
    primitives: str | None = None,
    metrics: Metrics | None = None,
) -> Version:
    """Publish what the newest checkpoint of a run holds, and say so in the run's status.

    Args:
        path: of the run, which no process may be running.
        registry: directory to publish in.
        name: of what is published; None: the run's.
        primitives: published version that a policy of a task acts with, if that has another name than in its run.
        metrics: what is known of it; None: measure it on the goals of the end of a run.

    Returns:
        The new version, or the newest one of that name where it has the same parameters already.

    Raises:
        TandemError: no run, one that goes on, or what it has learned cannot be published; nothing was written.
    """
    directory = RunDirectory(path)
    config = directory.read_config()
    check_makes(config)
    changed = {"name": check_name(name or config.name)}
    directory.claim(resume=True)
    with closing(directory):
        learned = load(str(path.absolute()), registry, primitives)
        if learned.acts_with is not None:
            changed["primitives"] = learned.acts_with.reference
        config = config.model_copy(update=changed)
        check_publishable(config, registry)
        if metrics is None:
            saved = CheckpointStore(directory.checkpoints).load_latest()
            metrics = _measure(config, learned) | {"env_steps": saved.meta["env_steps"]}
        version = publish_run(directory, Registry(Path(registry)), config, learned.parameters, metrics)
        status, run_id = read_status(path), run_id_of(path)
        if status is not None and status.state not in ACTIVE:
            told = status.model_copy(update={"run_id": run_id, "published": str(version), "epoch": directory.epoch})
            with closing(RunWriter(directory)) as writer:
                writer.status(told)
            # the version is there, so no trouble with Redis is one of this call
            with suppress(TandemError), closing(reporting_to(directory, run_id, address_from_environment())) as writer:
                writer.status(told)
    return version


def _measure(config: Config, learned: Trained) -> Metrics:
    """Success of what was learned, on the goals of the end of a run; not what a method of a user's measures itself."""
    if isinstance(config, SkillDiscoveryConfig):
        return measure_skills(config, learned.parameters)
    if isinstance(config, TaskConfig):
        seed, run = config.seed + FINAL_SEED, config.run
        player, task = learned.player(), find_task(config.task, config.code, config.task_world)
        found = evaluate_on(task, config.world, player, run.final_episodes, seed, run.num_threads)
        return {f"evaluation/{key}": value for key, value in numbers_of(found).items()}
    return measure_bob(config, learned.parameters)
