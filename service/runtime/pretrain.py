"""A pre-training run from the first signal handler to the published primitives."""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from service.actors.evaluation import evaluate
from service.config import Config, ConfigError
from service.envs.goals import GOAL_KINDS
from service.envs.observations import ACTION_SIZE, BOB_SIZE, NORMALISATION_BOB, POSITIONS_SIZE
from service.policies.evaluator import bob_evaluator
from service.registry.names import Version
from service.registry.registry import Registry
from service.runtime.artifacts import make_artifacts
from service.runtime.local import EVALUATION_SEED, LocalRun, OnIteration, RunResult
from service.runtime.rundir import RunDirectory

FINAL_EVALUATION_EPISODES = 300
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Pretrained:
    """What a run made."""

    result: RunResult
    files: dict[str, Path]
    """Pictures and video by what they show."""
    version: Version | None
    """Of the published primitives; None when interrupted."""
    metrics: dict[str, float]
    """Of the final evaluation."""
    timing: str
    """Where the time went, as a text tree."""


def pretrain(
    config: Config, directory: RunDirectory, registry: Path, *, resume: bool = False, on_iteration: OnIteration
) -> Pretrained:
    """Run to the end, then evaluate, draw and publish. SIGINT and SIGTERM end it after the current iteration, saved.

    Raises:
        TandemError: see ``LocalRun`` and ``RunDirectory.start``.
    """
    run = LocalRun(config, directory, resume=resume)
    try:
        with _stop_on_signals(run):
            result = run.run(on_iteration)
        metrics: dict[str, float] = {}
        version = None
        files: dict[str, Path] = {}
        if result.reason != "interrupted":
            _logger.info("learning is over; now evaluating, publishing, drawing and filming")
            metrics = _final_evaluation(config, run)
            if config.policy.monolithic_bob is None:
                version = _publish(config, directory, registry, run, metrics)
            files = make_artifacts(directory)
        return Pretrained(result, files, version, metrics, run.timing.tree())
    finally:
        directory.close()


def resumed_config(directory: RunDirectory, overrides: list[str]) -> Config:
    """The configuration to resume a run with: the saved one, where only ``run.*`` may be changed.

    Raises:
        ConfigError: no run there, or an override of anything else.
    """
    for override in overrides:
        if not override.startswith("run."):
            raise ConfigError(
                f"override {override!r}: a resumed run keeps its configuration; only run.* may change, "
                "for example run.total_env_steps"
            )
    directory.read_config()
    from service.config import load_config

    return load_config(directory.config_file, overrides)


@contextmanager
def _stop_on_signals(run: LocalRun) -> Iterator[None]:
    """The first SIGINT or SIGTERM asks the run to end; a second one ends the process as usual."""
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def request_stop(number: int, frame: FrameType | None) -> None:
        run.request_stop()
        for each, handler in previous.items():
            signal.signal(each, handler)

    for number in previous:
        signal.signal(number, request_stop)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _final_evaluation(config: Config, run: LocalRun) -> dict[str, float]:
    bob = bob_evaluator(run.learner.weights().bob)
    metrics = {}
    for kind in GOAL_KINDS:
        result = evaluate(
            bob,
            config.world,
            kind,
            num_episodes=FINAL_EVALUATION_EPISODES,
            num_steps=config.run.evaluation_steps,
            success_distance_m=config.game.success_distance_m,
            seed=EVALUATION_SEED + 1,
            num_threads=config.run.num_threads,
        )
        metrics[f"evaluation/{kind}_success_last"] = result.success_last
        metrics[f"evaluation/{kind}_success_ever"] = result.success_ever
    return metrics


def _publish(
    config: Config, directory: RunDirectory, registry: Path, run: LocalRun, metrics: dict[str, float]
) -> Version:
    return Registry(registry).publish(
        config.name,
        run.learner.weights().bob,
        spaces={
            "action": ACTION_SIZE,
            "positions": POSITIONS_SIZE,
            "observation": BOB_SIZE,
            "layout": "service.envs.observations",
        },
        normalisation={"offset": NORMALISATION_BOB.offset.tolist(), "scale": NORMALISATION_BOB.scale.tolist()},
        config=config.model_dump(mode="json"),
        metrics=metrics | {"env_steps": run.num_env_steps},
    )
