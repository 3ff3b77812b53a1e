"""A pre-training run from the first signal handler to the published primitives."""

from __future__ import annotations

import json
import logging
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from service.config import Config, ConfigError, load_config
from service.registry.names import Version
from service.registry.registry import Registry
from service.runtime.artifacts import make_artifacts
from service.runtime.local import LocalRun, OnIteration, RunResult
from service.runtime.publishing import measure_bob, publish_run
from service.runtime.rundir import RunDirectory

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
        TandemError: see ``LocalRun`` and ``RunDirectory.start``; or a registry that is only read.
    """
    Registry(registry).check_writable()  # now, not after hours of learning
    run = LocalRun(config, directory, resume=resume)
    try:
        with _stop_on_signals(run):
            result = run.run(on_iteration)
        metrics: dict[str, float] = {}
        version = None
        files: dict[str, Path] = {}
        if result.reason != "interrupted":
            _logger.info("learning is over; now evaluating, publishing, drawing and filming")
            bob = run.learner.weights().bob
            metrics = measure_bob(config, bob)
            if config.policy.monolithic_bob is None:
                about = metrics | {"env_steps": run.num_env_steps}
                version = publish_run(directory, Registry(registry), config, bob, about)
            files = make_artifacts(directory)
        return Pretrained(result, files, version, metrics, run.timing.tree())
    finally:
        directory.close()


def resumed_config(directory: RunDirectory, overrides: list[str], file: Path | None = None) -> Config:
    """The configuration to resume a run with: the saved one, where only ``run.*`` may be changed.

    Args:
        directory: of the run.
        overrides: ``run.a=b`` strings.
        file: YAML that says the same as the saved one outside ``run``; what it says there comes before ``overrides``.

    Raises:
        ConfigError: no run there, an override of anything else, or a file that says otherwise.
    """
    for override in overrides:
        if not override.startswith("run."):
            raise ConfigError(
                f"override {override!r}: a resumed run keeps its configuration; only run.* may change, "
                "for example run.total_env_steps"
            )
    saved = directory.read_config()
    if file is not None:
        given = load_config(file)
        _check_same_outside_run(saved, given, file)
        named = given.run.model_dump(mode="json", exclude_unset=True)
        overrides = [f"run.{key}={json.dumps(value)}" for key, value in named.items()] + overrides
    return load_config(directory.config_file, overrides)


def _check_same_outside_run(saved: Config, given: Config, file: Path) -> None:
    left, right = (dict(_leaves(config.model_dump(mode="json", exclude={"run"}))) for config in (saved, given))
    for key in sorted(left.keys() | right.keys()):
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
