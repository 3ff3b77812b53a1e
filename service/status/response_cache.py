"""A cache of answers for half a second, shared by all clients.

A run writes its status once a second, and a dashboard that is open in ten browsers asks ten times for the same. Reading
files and Redis, merging and validating for each request would take CPU time from the training on the same machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

AGE_S = 0.5
"""Greatest age of a cached answer."""
MAX_ANSWERS, MAX_BYTES = 64, 1 << 18
"""Number of cached answers, and length of a cached body: metrics of a whole run in 1,000 points are about 100 kB."""
_TYPES = ("application/json", "text/plain", "application/openmetrics-text")
_UNCACHED = {"range", "if-none-match"}
"""Request headers that make the answer depend on what the client has."""
_ROUTE = "route"
"""Key of the ASGI scope in which the router leaves the route; requests are counted by it."""


@dataclass(frozen=True, slots=True)
class _Answer:
    until_s: float
    route: Any
    messages: tuple[Message, ...]


class ResponseCache:
    """ASGI middleware that caches answers to GET; any other request empties the cache.

    It belongs behind ``AuthMiddleware``. Only ``/metrics`` and paths below ``/v1`` are cached, if the status is 200
    and the body is one piece of JSON or plain text: no event streams and no downloads.
    """

    def __init__(self, app: ASGIApp, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Wrap ``app``; ``clock`` counts seconds."""
        self._app, self._clock = app, clock
        self._answers: dict[tuple[str, bytes, str], _Answer] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer from the cache, or pass the request on."""
        if scope["type"] == "http" and scope["method"] != "GET":
            try:
                await self._app(scope, receive, send)
            finally:
                self._answers.clear()
        elif scope["type"] == "http" and _may_be_cached(scope):
            await self._get(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _get(self, scope: Scope, receive: Receive, send: Send) -> None:
        key = (scope["path"], scope["query_string"], Headers(scope=scope).get("accept", ""))
        known = self._answers.get(key)
        if known is not None and self._clock() < known.until_s:
            scope[_ROUTE] = known.route
            for message in known.messages:
                await send(dict(message))  # a copy, because the middleware before this one adds headers to it
            return
        messages: list[Message] = []

        async def keep(message: Message) -> None:
            if len(messages) < 2:  # streams and files send more, and are not cached
                messages.append(dict(message))
            await send(message)

        asked_s = self._clock()
        await self._app(scope, receive, keep)
        if _is_cacheable(messages):
            if len(self._answers) >= MAX_ANSWERS:
                self._answers.clear()
            self._answers[key] = _Answer(asked_s + AGE_S, scope.get(_ROUTE), tuple(messages))


def _may_be_cached(scope: Scope) -> bool:
    path = scope["path"]  # health checks are not here: their answer depends on who asks
    return (path == "/metrics" or path.startswith("/v1/")) and _UNCACHED.isdisjoint(Headers(scope=scope).keys())


def _is_cacheable(messages: list[Message]) -> bool:
    if [message["type"] for message in messages] != ["http.response.start", "http.response.body"]:
        return False
    start, body = messages
    media_type = Headers(raw=start["headers"]).get("content-type", "").partition(";")[0]
    return (
        start["status"] == HTTPStatus.OK
        and media_type in _TYPES
        and not body.get("more_body", False)
        and len(body.get("body", b"")) <= MAX_BYTES
    )
