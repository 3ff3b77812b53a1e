"""A watch over the raylet of this machine, Ray's process for a node: while it is frozen, Ray does nothing here.

The driver's own calls wait in it, too, some of them for ever. So a thread of its own asks it.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Event, Thread
from typing import Self

import ray
from ray._private.grpc_utils import init_grpc_channel

from service.cluster.watch import Clock

PROBE_S = 0.5
SILENT_S = 5.0
"""A raylet that has not answered for so long may be frozen; until it answers, no other process is called hung."""
LOST_S = 40.0
"""One that has not answered for so long is given up."""


class RayletWatch:
    """A context manager that asks the raylet of this node again and again whether it is well.

    Args:
        on_lost: called once, in a thread, with a line that says so when the raylet is given up.
    """

    def __init__(self, on_lost: Callable[[str], None]) -> None:
        own = ray.get_runtime_context().get_node_id()
        node = next(each for each in ray.nodes() if each["NodeID"] == own)
        self._on_lost = on_lost
        self._channel = init_grpc_channel(f"{node['NodeManagerAddress']}:{node['NodeManagerPort']}")
        self._over = Event()
        self.answers = False
        """Whether it has ever answered; one that has not may be out of reach, and well."""
        self.silent = False
        """Whether it has not answered for some seconds."""
        self._thread = Thread(target=self._watch, name="raylet", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()
        self._channel.close()

    def _watch(self) -> None:
        ask = self._channel.unary_unary("/grpc.health.v1.Health/Check")
        clock, answer = Clock(), ask.future(b"")
        while not self._over.wait(PROBE_S):
            clock.look()
            if answer.done():
                if answer.exception() is None:
                    clock, self.answers = Clock(), True
                answer = ask.future(b"")
            self.silent = self.answers and clock.now > SILENT_S
            if self.answers and clock.now > LOST_S:
                self._on_lost(f"Ray's process for this machine, the raylet, has not answered for {clock.now:.0f} s")
                return
