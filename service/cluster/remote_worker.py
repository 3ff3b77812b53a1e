"""Workers in other processes whose state the driver keeps: the learner and the task generator."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

import ray
from ray.exceptions import GetTimeoutError, ObjectLostError, RayActorError, RayError, RayTaskError

from service.base.errors import TandemError
from service.cluster.ray_actors import Location
from service.cluster.watch import Clock, Watch
from service.methods.method import StateLostError, WorkersError
from service.store.models import ActorStatus

START_S = 120.0
"""A worker that has not started by then will not; torch is imported within it, and images are loaded on a new node."""
ANSWER_S = 80.0
"""A worker that is alive and has nothing to do answers within it."""
START_ATTEMPTS = 4
"""Times that a worker is started in place of one, before its state is given up."""
BACK_OFF_S = 0.5
"""Pause after the first of them that failed; it doubles."""
POLL_S = 0.2
_logger = logging.getLogger(__name__)
OnWait = Callable[[], None]


class RemoteWorker:
    """A worker, and all that is needed to start the next one in its place.

    It gets its state by ``start``, not as it is made: Ray prints the errors of that with their tracebacks.

    Args:
        name: of the worker, for people.
        actor: Ray's actor class, with its options.
        config: what it is made with.
        state: the state to start from, or None.
        clock: of the driver.
        on_wait: called again and again while the driver waits for it to start.
    """

    def __init__(self, name: str, actor: Any, config: Any, state: Any, clock: Clock, on_wait: OnWait) -> None:
        self.name, self._clock, self._on_wait = name, clock, on_wait
        self.state = ray.put(state)
        """Reference to its newest state."""
        self.incarnation = 0
        self._actor, self._config = actor, config
        self._last_error: str | None = None
        self._hung: str | None = None
        self._location: Location | None
        self._spawn()

    def start(self) -> None:
        """Wait until it has started; one that dies meanwhile is started anew.

        Raises:
            WorkersError: it does not start.
        """
        for pause_s in _pauses():
            try:
                self.wait_ready()
                return
            except RayActorError as error:
                reason = one_line(error)
                _logger.warning("the %s died while it started (%s); another takes its place", self.name, reason)
                self._start_next(pause_s)
        raise WorkersError(f"the {self.name} died {START_ATTEMPTS} times while it started, at last with: {reason}")

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
            except (RayError, WorkersError) as error:
                reason = one_line(error)
                _logger.warning("the %s did not start (%s)", self.name, reason)
                if lost(error):
                    break
        raise StateLostError(f"the {self.name} cannot go on from its last state ({reason})")

    def end_if_hung(self) -> None:
        """Kill it if it hangs; what it was asked then fails. To be asked often."""
        if self._hung is None and (reason := self.watch.look()) is not None:
            _logger.warning("the %s hangs: %s", self.name, reason)
            self._hung = reason
            self.close()

    @property
    def alive(self) -> bool:
        """Whether it answers. Only to be asked while it has nothing to do, or soon will."""
        try:
            wait_for([self.handle.ping.remote()], ANSWER_S, self._on_wait)
        except RayError:
            return False
        return True

    def wait_ready(self) -> None:
        """Wait until it has started, and has its state.

        Raises:
            WorkersError: it has not in time, or cannot.
            RayError: it died.
        """
        try:
            (self._location,) = wait_for([self.handle.start.remote([self.state])], START_S, self._on_wait)
        except GetTimeoutError:
            raise WorkersError(
                f"the {self.name} did not start within {START_S:.0f} s: does a node of the cluster answer, and has one "
                "what it asks for (a GPU, with learner.device=cuda)? see ray status"
            ) from None
        except RayTaskError as error:
            if isinstance(error.cause, TandemError):  # for people; where it was raised is not
                raise WorkersError(str(error.cause)) from None
            raise

    def explain(self, error: BaseException) -> str:
        """The reason in a line why it failed."""
        return self._hung or one_line(error)

    def close(self) -> None:
        """Kill it."""
        ray.kill(self.handle, no_restart=True)

    def status(self) -> ActorStatus:
        """Its state for the status service."""
        return self.watch.status(self.name, self.incarnation, self._location, self._last_error)

    def _start_next(self, pause_s: float) -> None:
        self.close()
        pause(pause_s, self._on_wait)
        self.incarnation += 1
        self._hung = None
        self._spawn()

    def _spawn(self) -> None:
        """Make its process, which need not be up."""
        self.handle = self._actor.remote(self._config)
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
