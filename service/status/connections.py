"""Connections of the status service, bounded: in number, in the size of a request's head, and in the time it may take.

What a client sends before its request is whole costs memory and a place, and nobody has seen a token yet.
"""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

MAX_CONNECTIONS = 512
"""Open at once; further ones are closed with 503."""
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


class BoundedConnection(HttpToolsProtocol):
    """One connection of uvicorn's, with these bounds."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._in_head = True
        self._num_heads = self._num_head_bytes = 0
        self._deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request, or close one connection too many."""
        if len(self.connections) >= MAX_CONNECTIONS:
            transport.write(_BUSY)
            transport.close()
            return
        super().connection_made(transport)
        self._wait_for_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget it."""
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
        self._in_head, self._num_head_bytes = False, 0
        self._num_heads += 1
        self._stop_waiting()
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """Expect the next request."""
        super().on_message_complete()
        self._in_head = True

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
