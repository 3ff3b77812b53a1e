"""Trackers: metrics also to Weights & Biases, MLflow, or anything else that a function of the user makes."""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from service.base.errors import TandemError, one_line

_logger = logging.getLogger(__name__)
_ENDS = ("close", "finish")
"""Names of what ends a tracker, one of which is called where it is there."""


class Trackers:
    """The trackers of a run, until ``close``.

    A tracker that throws is left out from then on, which is said once; training goes on. They are called between
    iterations by the process that has the run, on a cluster its driver, so that one that waits makes the run wait.

    Args:
        references: of factories, ``module:factory`` each; modules are found in the working directory, too.
        name: of the run.
        config: of the run.

    Raises:
        TandemError: no such factory, or one that throws or makes something without ``log``.
    """

    def __init__(self, references: Sequence[str], name: str, config: Mapping[str, Any]) -> None:
        factories = {reference: find_factory(reference) for reference in references}
        self._going: dict[str, Any] = {}
        try:
            for reference, factory in factories.items():
                self._going[reference] = _make(reference, factory, name, dict(config))
        except BaseException:
            self.close()
            raise

    def log(self, metrics: Mapping[str, float]) -> None:
        """Give a record, which has ``env_steps`` in it, to all that have not thrown."""
        for reference, tracker in list(self._going.items()):
            try:
                tracker.log(dict(metrics), step=int(metrics["env_steps"]))
            except Exception as error:  # whatever it is, the run is worth more
                self._end(reference, error)

    def close(self) -> None:
        """End them."""
        for reference in list(self._going):
            self._end(reference)

    def _end(self, reference: str, error: Exception | None = None) -> None:
        tracker = self._going.pop(reference)
        ends = [getattr(tracker, name, None) for name in _ENDS]
        try:
            next(filter(callable, ends), lambda: None)()
        except Exception as failure:
            error = error or failure
        if error is not None:
            _logger.warning("tracker %s is left out from now on, the run goes on: %s", reference, _told(error))


def find_factory(reference: str) -> Callable[..., Any]:
    """The factory that ``--tracker`` names.

    It makes an object with ``log(metrics, step)``, the number of env steps, of a run's name and configuration.

    Raises:
        TandemError: there is none by that name.
    """
    module, _, name = reference.partition(":")
    before = list(sys.path)
    sys.path.insert(0, "")  # the command, unlike python -m, does not look into the working directory
    try:
        factory: Callable[..., Any] = getattr(importlib.import_module(module), name)
    except Exception as error:  # of the module's own code, too
        raise TandemError(
            f"--tracker {reference!r} cannot be loaded: {_told(error)}; write module:factory, such as my_trackers:wandb"
        ) from None
    finally:
        sys.path[:] = before
    return factory


def _make(reference: str, factory: Callable[..., Any], name: str, config: dict[str, Any]) -> Any:
    try:
        tracker = factory(name, config)
    except Exception as error:
        raise TandemError(
            f"--tracker {reference!r}, called with the run's name and configuration: {_told(error)}"
        ) from None
    if not callable(getattr(tracker, "log", None)):
        raise TandemError(
            f"--tracker {reference!r} made something without log, of type {type(tracker).__name__}: give an object "
            "with log(metrics, step)"
        )
    return tracker


def _told(error: Exception) -> str:
    return one_line(f"{type(error).__name__}: {error}", 300)
