"""A worker in another process whose state the driver keeps: the task generator."""

from __future__ import annotations

import logging
from datetime import UTC, datetime
from typing import Any

import ray
from ray.exceptions import GetTimeoutError, RayError

from service.runtime.ray_actors import Location
from service.runtime.runner import ClusterError, StateLostError
from service.store.models import ActorStatus

START_S = 120.0
"""A worker that has not started by then will not; torch is imported within it, and images are loaded on a new node."""
ANSWER_S = 20.0
"""A worker that is alive and has nothing to do answers within it."""
_logger = logging.getLogger(__name__)


class RemoteWorker:
    """A worker, and all that is needed to start the next one in its place.

    Args:
        name: of the worker, for people.
        actor: Ray's actor class, with its options.
        config: first argument of the worker.
        state: second one: the state to start from, or None.
    """

    def __init__(self, name: str, actor: Any, config: Any, state: Any) -> None:
        self.name = name
        self.state = ray.put(state)
        """Reference to its newest state."""
        self.incarnation = 0
        self.handle = actor.remote(config, self.state)
        self._actor, self._config = actor, config
        self._location = Location("", 0)
        self._heartbeat = datetime.now(UTC)
        self._last_error: str | None = None

    def wait_ready(self) -> None:
        """Wait until it has started.

        Raises:
            ClusterError: it does not start.
        """
        try:
            self._location = ray.get(self.handle.ping.remote(), timeout=START_S)
        except GetTimeoutError:
            raise ClusterError(
                f"the {self.name} did not start within {START_S:.0f} s: does a node of the cluster answer? see ray "
                "status"
            ) from None
        self.record_heartbeat()

    def record_heartbeat(self) -> None:
        """Note that it just answered."""
        self._heartbeat = datetime.now(UTC)

    @property
    def alive(self) -> bool:
        """Whether it answers. Only to be asked while it has nothing to do."""
        try:
            ray.get(self.handle.ping.remote(), timeout=ANSWER_S)
        except RayError:
            return False
        return True

    def explain(self, error: BaseException) -> str:
        """The reason in a line why it failed."""
        return one_line(error)

    def restart(self, reason: str) -> None:
        """Start another from the newest state; what the last one was doing has to be asked of it again.

        Raises:
            StateLostError: it does not start, or the state was lost with the node that kept it.
        """
        _logger.warning("the %s is gone (%s); another goes on from its last state", self.name, reason)
        ray.kill(self.handle, no_restart=True)
        self.incarnation += 1
        self._last_error = reason
        self.handle = self._actor.remote(self._config, self.state)
        try:
            self.wait_ready()
        except RayError as error:
            raise StateLostError(
                f"the {self.name} cannot go on from its last state ({one_line(error)}); the run goes back to its "
                "newest checkpoint"
            ) from None

    def close(self) -> None:
        """Kill the worker."""
        ray.kill(self.handle, no_restart=True)

    def status(self) -> ActorStatus:
        """The worker's state for the status service."""
        return ActorStatus(
            name=self.name,
            incarnation=self.incarnation,
            state="alive",
            node=self._location.node,
            pid=self._location.pid,
            heartbeat=self._heartbeat,
            last_error=self._last_error,
        )


def one_line(error: BaseException) -> str:
    """An error from another process in a line: the end of its traceback, which says what it was."""
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[-1].strip() if text else ''}"[:200]
