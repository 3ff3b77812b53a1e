"""Workers in other processes whose state the driver keeps, and the one of a single process: the task generator."""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import ray
from ray.exceptions import GetTimeoutError, ObjectLostError, RayActorError, RayError, RayTaskError

from service.runtime.ray_actors import Location
from service.runtime.runner import ClusterError, StateLostError
from service.runtime.watch import Clock, Watch
from service.store.models import ActorStatus

START_S = 120.0
"""A worker that has not started by then will not; torch is imported within it, and images are loaded on a new node."""
ANSWER_S = 20.0
"""A worker that is alive and has nothing to do answers within it."""
RANK_ANSWER_S = 60.0
"""A rank gives up one that does not take part in a gradient step for so long: long after the driver would have ended
it, and longer than a machine may sleep."""
START_ATTEMPTS = 4
"""Times that a worker is started in place of one, before its state is given up."""
BACK_OFF_S = 0.5
"""Pause after the first of them that failed; it doubles."""
POLL_S = 0.2
_logger = logging.getLogger(__name__)
OnWait = Callable[[], None]


class Worker(ABC):
    """A worker, and all that is needed to start the next one in its place.

    Args:
        name: of the worker, for people.
        clock: of the driver.
        on_wait: called again and again while the driver waits for it to start.
    """

    def __init__(self, name: str, clock: Clock, on_wait: OnWait) -> None:
        self.name, self._clock, self._on_wait = name, clock, on_wait
        self.incarnation = 0
        self._last_error: str | None = None
        self._hung: str | None = None

    def start(self) -> None:
        """Wait until it has started; one that dies meanwhile is started anew.

        Raises:
            ClusterError: it does not start.
        """
        for pause_s in _pauses():
            try:
                self.wait_ready()
                return
            except RayActorError as error:
                reason = one_line(error)
                _logger.warning("the %s died while it started (%s); another takes its place", self.name, reason)
                self._start_next(pause_s)
        raise ClusterError(f"the {self.name} died {START_ATTEMPTS} times while it started, at last with: {reason}")

    def restart(self, reason: str) -> None:
        """Start another from the newest state; what the last one was doing has to be asked of it again.

        One that dies while it starts is started again, so nothing is lost with it.

        Raises:
            StateLostError: it does not start, or a state was lost with the node that kept it.
        """
        _logger.warning("the %s is gone (%s); another goes on from its last state", self.name, reason)
        self._last_error = reason
        for pause_s in _pauses():
            self._start_next(pause_s)
            try:
                self.wait_ready()
                _logger.info("the %s is back, as its incarnation %d", self.name, self.incarnation)
                return
            except (RayError, ClusterError) as error:
                reason = one_line(error)
                _logger.warning("the %s did not start (%s)", self.name, reason)
                if lost(error):
                    break
        raise StateLostError(f"the {self.name} cannot go on from its last state ({reason})")

    def end_if_hung(self) -> None:
        """Kill it if it hangs; what it was asked then fails. To be asked often."""
        if self._hung is None and (reason := self._look()) is not None:
            _logger.warning("the %s hangs: %s", self.name, reason)
            self._hung = reason
            self.close()

    @property
    def alive(self) -> bool:
        """Whether all its processes answer. Only to be asked while they have nothing to do, or soon will."""
        try:
            wait_for(self._pings(), RANK_ANSWER_S + ANSWER_S, self._on_wait)
        except RayError:
            return False
        return True

    def _start_next(self, pause_s: float) -> None:
        self.close()
        pause(pause_s, self._on_wait)
        self.incarnation += 1
        self._hung = None
        self._spawn()

    @abstractmethod
    def wait_ready(self) -> None:
        """Wait until it has started.

        Raises:
            ClusterError: it has not, or not in time.
            RayError: it died.
        """

    @abstractmethod
    def _look(self) -> str | None:
        """The reason in a few words why it hangs, if it does."""

    @abstractmethod
    def _pings(self) -> list[Any]:
        """Ask all its processes whether they live; references to their answers."""

    @abstractmethod
    def explain(self, error: BaseException) -> str:
        """The reason in a line why it failed."""

    @abstractmethod
    def close(self) -> None:
        """Kill it."""

    @abstractmethod
    def _spawn(self) -> None:
        """Make its processes, which need not be up."""


class RemoteWorker(Worker):
    """A worker of one process.

    Args:
        name: of the worker, for people.
        actor: Ray's actor class, with its options.
        config: first argument of the worker.
        state: second one: the state to start from, or None.
        clock: of the driver.
        on_wait: called again and again while the driver waits for it to start.
    """

    def __init__(self, name: str, actor: Any, config: Any, state: Any, clock: Clock, on_wait: OnWait) -> None:
        super().__init__(name, clock, on_wait)
        self.state = ray.put(state)
        """Reference to its newest state."""
        self._actor, self._config = actor, config
        self._location: Location | None
        self._spawn()

    def wait_ready(self) -> None:
        """Wait until it has started."""
        try:
            (found,) = wait_for(self._pings(), START_S, self._on_wait)
        except GetTimeoutError:
            raise ClusterError(
                f"the {self.name} did not start within {START_S:.0f} s: does a node of the cluster answer? see ray "
                "status"
            ) from None
        self._location = found

    def explain(self, error: BaseException) -> str:
        """The reason in a line why it failed."""
        return self._hung or one_line(error)

    def close(self) -> None:
        """Kill the worker."""
        ray.kill(self.handle, no_restart=True)

    def status(self) -> ActorStatus:
        """The worker's state for the status service."""
        return self.watch.status(self.name, self.incarnation, self._location, self._last_error)

    def _look(self) -> str | None:
        return self.watch.look()

    def _pings(self) -> list[Any]:
        return [self.handle.ping.remote()]

    def _spawn(self) -> None:
        self.handle = self._actor.remote(self._config, self.state)
        self.watch = Watch(self.handle.progress.remote, self._clock)
        self._location = None


def wait_for(answers: Sequence[Any], timeout_s: float, on_wait: OnWait) -> list[Any]:
    """Wait for what workers were asked, and call ``on_wait`` meanwhile.

    Raises:
        GetTimeoutError: one of them has not answered in time.
        RayError: one of them failed.
    """
    clock = Clock()
    while True:
        ready, missing = ray.wait(list(answers), num_returns=len(answers), timeout=POLL_S)
        ray.get(ready)  # one that failed ends the wait for the others
        if not missing:
            return list(ray.get(list(answers)))
        clock.look()
        if clock.now > timeout_s:
            raise GetTimeoutError
        on_wait()


def pause(seconds: float, on_wait: OnWait) -> None:
    """Wait, and call ``on_wait`` meanwhile."""
    until_s = time.monotonic() + seconds
    while (left_s := until_s - time.monotonic()) > 0.0:
        time.sleep(min(POLL_S, left_s))
        on_wait()


def lost(error: BaseException) -> bool:
    """Whether a call failed because an argument of it was lost with a node."""
    return isinstance(error, RayTaskError) and isinstance(error.cause, ObjectLostError)


def one_line(error: BaseException) -> str:
    """An error from another process in a line: the end of its traceback, which says what it was."""
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[-1].strip() if text else ''}"[:200]


def _pauses() -> list[float]:
    """Time to wait before each attempt to start a worker."""
    return [0.0, *(BACK_OFF_S * 2**attempt for attempt in range(START_ATTEMPTS - 1))]
