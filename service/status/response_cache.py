"""A cache of answers for half a second, shared by all clients.

A run writes its status once a second, and a dashboard that is open in ten browsers asks ten times for the same. Reading
files and Redis, merging and validating for each request would take CPU time from the training on the same machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable
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


class ResponseCache:
    """ASGI middleware that caches answers to GET; any other request empties the cache.

    It belongs behind ``AuthMiddleware``. Only ``/metrics`` and paths below ``/v1`` are cached, if the status is 200
    and the body is one piece of JSON or plain text: no event streams and no downloads.
    """

    def __init__(self, app: ASGIApp, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._app, self._clock = app, clock
        self._answers: dict[tuple[str, bytes, str], tuple[float, Any, list[Message]]] = {}
        """Time until which it counts, route and messages of each answer, by path, query and accepted media types."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer from the cache, or pass the request on."""
        if scope["method"] != "GET":
            try:
                await self._app(scope, receive, send)
            finally:
                self._answers.clear()
        elif _may_be_cached(scope):
            await self._get(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _get(self, scope: Scope, receive: Receive, send: Send) -> None:
        key = (scope["path"], scope["query_string"], Headers(scope=scope).get("accept", ""))
        until_s, route, messages = self._answers.get(key, (0.0, None, []))
        if self._clock() < until_s:
            scope["route"] = route  # where the router leaves it: requests are counted by it
            for message in messages:
                await send(dict(message))  # a copy, because the middleware before this one adds headers to it
            return
        messages = []

        async def keep(message: Message) -> None:
            if len(messages) < 2:  # streams and files send more, and are not cached
                messages.append(dict(message))
            await send(message)

        asked_s = self._clock()
        await self._app(scope, receive, keep)
        if _is_cacheable(messages):
            if len(self._answers) >= MAX_ANSWERS:
                self._answers.clear()
            self._answers[key] = (asked_s + AGE_S, scope.get("route"), messages)


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
