"""Workers in other processes whose state the driver keeps: the learner and the task generator."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

import ray
from ray.exceptions import ObjectLostError, RayActorError, RayError, RayTaskError

from service.cluster.ray_connection import last_line
from service.cluster.watch import Clock, Watch
from service.methods.method import StateLostError, WorkersError
from service.store.models import ActorStatus

START_S = 120.0
"""A worker that has not started by then will not; torch is imported within it, and images are loaded on a new node."""
START_ATTEMPTS = 4
"""Times that a worker is started in place of one, before its state is given up."""
BACK_OFF_S = 0.5
"""Pause after the first of them that failed; it doubles."""
POLL_S = 0.2
_logger = logging.getLogger(__name__)


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

    def __init__(
        self, name: str, actor: Any, config: Any, state: Any, clock: Clock, on_wait: Callable[[], None]
    ) -> None:
        self.name, self._actor, self._config, self._clock, self._on_wait = name, actor, config, clock, on_wait
        self.state = ray.put(state)
        """Reference to its newest state."""
        self.answer: Any = None
        """Reference to the answer that it owes; None where it owes none."""
        self.made: list[Any] = []
        """References to what it has made at its start, or makes with its answer."""
        self._last_error: str | None = None
        self._hung: str | None = None
        self._spawn(0)

    def start(self, retried: tuple[type[Exception], ...] = (RayActorError,)) -> None:
        """Wait until it has started, and has its state.

        Args:
            retried: after these errors it is started anew, so one that dies meanwhile loses nothing.

        Raises:
            WorkersError: it does not start.
            RayError: its state is lost, or something else that is not retried.
        """
        for attempt in range(START_ATTEMPTS):
            if attempt:
                self.close()
                time.sleep(BACK_OFF_S * 2 ** (attempt - 1))
                self._spawn(self.watch.incarnation + 1)
            try:
                self._wait_until_ready()
                return
            except retried as error:
                reason = last_line(error)
                _logger.warning("the %s did not start (%s)", self.name, reason)
        raise WorkersError(f"the {self.name} died {START_ATTEMPTS} times while it started, at last with: {reason}")

    def restart(self, error: Exception) -> str:
        """Start another from the newest state; what the last one was doing has to be asked of it again.

        Returns:
            Why the last one failed.

        Raises:
            StateLostError: it does not start, or a state was lost with the node that kept it.
        """
        self._last_error = reason = self._hung or last_line(error)
        _logger.warning("the %s is gone (%s); another goes on from its last state", self.name, reason)
        self.close()
        self._spawn(self.watch.incarnation + 1)
        try:
            self.start((RayActorError, WorkersError))
        except (RayError, WorkersError) as failed:
            raise StateLostError(f"the {self.name} cannot go on from its last state ({last_line(failed)})") from None
        _logger.info("the %s is back, as its incarnation %d", self.name, self.watch.incarnation)
        return reason

    def ask(self, call: str, *arguments: Any) -> None:
        """Ask it to do something; its ``answer`` comes when it is done."""
        self.answer, *self.made = getattr(self.watch.handle, call).remote(*arguments)
        self.watch.begin()

    def take_answer(self) -> Any:
        """Its answer, which is there; it owes none any more.

        Raises:
            RayError: it failed.
        """
        answer, self.answer = self.answer, None
        self.watch.end()
        return ray.get(answer)

    def end_if_hung(self) -> None:
        """Kill it if it hangs; what it was asked then fails. To be asked often."""
        if self._hung is None and (reason := self.watch.look()) is not None:
            _logger.warning("the %s hangs: %s", self.name, reason)
            self._hung = reason
            self.close()

    def close(self) -> None:
        """Kill it."""
        ray.kill(self.watch.handle, no_restart=True)

    def status(self) -> ActorStatus:
        """Its state for the status service."""
        return self.watch.status(self._last_error, num_replaced=self.watch.incarnation)

    def _spawn(self, incarnation: int) -> None:
        """Make its next process, which need not be up."""
        self.watch = Watch(self.name, incarnation, self._actor.remote(self._config), self._clock)
        self._hung = None

    def _wait_until_ready(self) -> None:
        """Wait until it has its state.

        Raises:
            WorkersError: it has not in time.
            RayError: it died, or cannot.
        """
        answer, *self.made = self.watch.handle.start.remote([self.state])
        clock = Clock()
        while not ray.wait([answer], timeout=POLL_S)[0]:
            clock.look()
            if clock.now > START_S:
                raise WorkersError(
                    f"the {self.name} did not start within {START_S:.0f} s: does a node of the cluster answer, and has "
                    "one what it asks for (a GPU, with learner.device=cuda)? see ray status"
                )
            self._on_wait()
        self.watch.location, *_ = ray.get([answer, *self.made])  # all: Ray prints errors that were not asked for


def lost(error: BaseException) -> bool:
    """Whether a call failed because an argument of it was lost with a node."""
    return isinstance(error, RayTaskError) and isinstance(error.cause, ObjectLostError)


def take_copies(copies: dict[Any, Any], ready: set[Any]) -> None:
    """Copy to this node what can be: it outlives the node that it is from. Processes of one machine share it.

    Args:
        copies: by reference; None until it is here.
        ready: references to what is there; one that was lost with its node is left out of the copies.
    """
    for reference in copies.keys() & ready:
        try:
            copies[reference] = ray.get(reference)
        except RayError:  # who needs it will say so
            del copies[reference]
