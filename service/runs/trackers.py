"""Trackers: metrics also to Weights & Biases, MLflow, or anything else that a function of the user makes."""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, Protocol, Self

from service.base.errors import TandemError, one_line

_logger = logging.getLogger(__name__)
_COUNTED = "env_steps"
"""The metric by which records are numbered."""
_ENDS = ("close", "finish")
"""Names of what ends a tracker, one of which is called where it is there."""


class Tracker(Protocol):
    """Takes metrics."""

    def log(self, metrics: dict[str, float], *, step: int) -> Any:
        """Take one record; ``step`` is the number of env steps."""


Factory = Callable[[str, dict[str, Any]], Tracker]
"""Makes a tracker of a run's name and its configuration, a tree of plain values."""


class Trackers:
    """The trackers of a run: a context manager that ends them.

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
        self._made: dict[str, Tracker] = {}
        self._left_out: set[str] = set()
        try:
            for reference, factory in factories.items():
                self._made[reference] = _make(reference, factory, name, dict(config))
        except BaseException:
            self._close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def log(self, metrics: Mapping[str, float]) -> None:
        """Give a record, which has ``env_steps`` in it, to all that have not thrown."""
        for reference, tracker in self._made.items():
            if reference not in self._left_out:
                try:
                    tracker.log(dict(metrics), step=int(metrics[_COUNTED]))
                except Exception as error:  # whatever it is, the run is worth more
                    self._leave_out(reference, error)

    def _close(self) -> None:
        for reference, tracker in self._made.items():
            try:
                for end in [getattr(tracker, name, None) for name in _ENDS]:
                    if callable(end):
                        end()
                        break
            except Exception as error:
                self._leave_out(reference, error)

    def _leave_out(self, reference: str, error: Exception) -> None:
        if reference not in self._left_out:
            self._left_out.add(reference)
            _logger.warning("tracker %s is left out from now on, the run goes on: %s", reference, _told(error))


def find_factory(reference: str) -> Factory:
    """The factory that ``--tracker`` names.

    Raises:
        TandemError: there is none by that name.
    """
    module, _, name = reference.partition(":")
    if not module or not name:
        raise TandemError(f"--tracker {reference!r}: write module:factory, such as my_trackers:wandb")
    before = list(sys.path)
    sys.path.insert(0, "")  # the command, unlike python -m, does not look into the working directory
    try:
        factory = getattr(importlib.import_module(module), name)
    except Exception as error:  # of the module's own code, too
        raise TandemError(f"--tracker {reference!r} cannot be loaded: {_told(error)}") from None
    finally:
        sys.path[:] = before
    if not callable(factory):
        raise TandemError(f"--tracker {reference!r} is no function: name one that makes a tracker")
    made: Factory = factory
    return made


def _make(reference: str, factory: Factory, name: str, config: dict[str, Any]) -> Tracker:
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
