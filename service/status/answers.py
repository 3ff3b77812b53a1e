"""Who asks what somebody asked a moment ago gets the same answer.

A run tells how it goes once a second, and a dashboard open in ten browsers asks the same as in one: reading files and
Redis, merging and validating them for each would take cores from the training beside it.
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
"""How old an answer may be; runs write their status once a second."""
MAX_ANSWERS, MAX_BYTES = 64, 1 << 18
"""How many are kept, and of how long a body: metrics of a whole run in 1,000 points have some 100 kB."""
_TYPES = ("application/json", "text/plain", "application/openmetrics-text")
_SINGULAR = {"range", "if-none-match"}
"""Headers of a request to which the answer depends on what the client has."""
_ROUTE = "route"
"""Where the router says in a scope which route it was; requests are counted by it."""


@dataclass(frozen=True, slots=True)
class _Answer:
    until_s: float
    route: Any
    messages: tuple[Message, ...]


class Answers:
    """ASGI middleware that keeps whole answers to GET for ``age_s``; one to anything else makes it forget them all.

    It belongs behind what decides who may ask. Only JSON and plain text below ``/v1`` and ``/metrics`` that came with
    200 and in one piece is kept, so neither event streams nor downloads.
    """

    def __init__(self, app: ASGIApp, *, age_s: float = AGE_S, clock: Callable[[], float] = time.monotonic) -> None:
        """``clock`` counts seconds."""
        self._app, self._age_s, self._clock = app, age_s, clock
        self._answers: dict[tuple[str, bytes, str], _Answer] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer from memory, or pass on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
        elif scope["method"] != "GET":
            try:
                await self._app(scope, receive, send)
            finally:
                self._answers.clear()
        elif _is_shared(scope):
            await self._get(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _get(self, scope: Scope, receive: Receive, send: Send) -> None:
        key = (scope["path"], scope["query_string"], Headers(scope=scope).get("accept", ""))
        known = self._answers.get(key)
        if known is not None and self._clock() < known.until_s:
            scope[_ROUTE] = known.route
            for message in known.messages:
                await send(dict(message))  # who counts and adds headers writes into it
            return
        messages: list[Message] = []

        async def keep(message: Message) -> None:
            if len(messages) < 2:  # more is a stream's or a file's
                messages.append(dict(message))
            await send(message)

        asked_s = self._clock()
        await self._app(scope, receive, keep)
        if _is_whole(messages):
            if len(self._answers) >= MAX_ANSWERS:
                self._answers.clear()
            self._answers[key] = _Answer(asked_s + self._age_s, scope.get(_ROUTE), tuple(messages))


def _is_shared(scope: Scope) -> bool:
    path = scope["path"]  # health depends on who asks
    return (path == "/metrics" or path.startswith("/v1/")) and _SINGULAR.isdisjoint(Headers(scope=scope).keys())


def _is_whole(messages: list[Message]) -> bool:
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
