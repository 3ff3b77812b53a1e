"""Connections of the status service, bounded: in number, in the size of a request's head, and in the time it may take.

What a client sends before its request is whole costs memory and a place, and nobody has seen a token yet.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from typing import Any
from weakref import WeakKeyDictionary

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.server import ServerState

MAX_CONNECTIONS = 512
"""Open at once. A further one takes the place of the one that has waited longest for a request to become whole; where
all have one, it is closed with 503."""
MAX_HEAD_BYTES = 64 * 1024
"""Request line and headers; a browser's have one or two kilobytes."""
HEAD_TIMEOUT_S = 10.0
_BUSY = (
    b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\nretry-after: 5\r\ncontent-type: text/plain\r\n"
    b"content-length: 29\r\n\r\ntoo many connections are open"
)
_TOO_LARGE = (
    b"HTTP/1.1 431 Request Header Fields Too Large\r\nconnection: close\r\ncontent-type: text/plain\r\n"
    b"content-length: 25\r\n\r\nthe headers are too large"
)


_idle_ones: WeakKeyDictionary[ServerState, OrderedDict[BoundedConnection, None]] = WeakKeyDictionary()
"""Connections of each server that wait for a request, the one that has waited longest first."""


class BoundedConnection(HttpToolsProtocol):
    """One connection of uvicorn's, with these bounds."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._in_head = True
        self._idle = _idle_ones.setdefault(self.server_state, OrderedDict())
        self._num_heads = self._num_head_bytes = 0
        self._deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request; one connection too many is closed, this one or another."""
        if len(self.connections) >= MAX_CONNECTIONS and not self._take_place():
            transport.write(_BUSY)
            transport.close()
            return
        super().connection_made(transport)
        self._idle[self] = None
        self._wait_for_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget it."""
        self._idle.pop(self, None)
        self._stop_waiting()
        if self.transport is not None:
            super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take what came, as long as the head is not too large."""
        if self.transport is None or self.transport.is_closing():
            return
        if was_in_head := self._in_head:
            self._wait_for_head()
        num_heads = self._num_heads
        super().data_received(data)
        if was_in_head and self._in_head and self._num_heads == num_heads:  # all of it belongs to a head still
            self._num_head_bytes += len(data)
            if self._num_head_bytes > MAX_HEAD_BYTES and not self.transport.is_closing():
                self.transport.write(_TOO_LARGE)
                self.transport.close()

    def on_headers_complete(self) -> None:
        """Go on with a request whose head is whole."""
        self._idle.pop(self, None)
        self._in_head, self._num_head_bytes = False, 0
        self._num_heads += 1
        self._stop_waiting()
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """Expect the next request."""
        super().on_message_complete()
        self._in_head = True

    def on_response_complete(self) -> None:
        """Be idle until the next request."""
        super().on_response_complete()
        if self._in_head and self.cycle.response_complete:  # no further request has begun
            self._idle[self] = None

    def _take_place(self) -> bool:
        """Close the connection that has been idle for longest; False where none is."""
        longest = next((each for each in self._idle if not each.transport.get_write_buffer_size()), None)
        if longest is None:
            return False
        longest._stop_waiting()
        del self._idle[longest]
        self.connections.discard(longest)
        longest.transport.abort()
        return True

    def _wait_for_head(self) -> None:
        if self._deadline is None:
            self._deadline = self.loop.call_later(HEAD_TIMEOUT_S, self._give_up)

    def _stop_waiting(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _give_up(self) -> None:
        self._deadline = None
        if self.transport is not None:
            self.transport.abort()
