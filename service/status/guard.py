"""What stands before every route, those added later included: who may ask, from where, how much, and in which headers.

A route cannot forget its token: here everything wants it but what ``OPEN`` lists.

| request | without a token in this service | with one, on loopback | with one, on a public address |
|---|---|---|---|
| GET ``/livez`` | answered | answered | answered |
| GET ``/readyz``, ``/healthz`` | answered | answered | answered, without reasons for those who have no token |
| any other GET | answered | answered; 401 if a wrong token is given | 401 without the token |
| POST, PUT, ... | 403 | 401 without the token | 401 without the token |

A service on a public address without a token does not start. GET takes the token as the password of HTTP Basic, too,
so that a browser can show the page; what changes state does not, or any web site could make such a browser do it.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import time
from collections.abc import Callable
from http import HTTPStatus

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.status.problems import ProblemError
from service.status.token import VARIABLE, judge

OPEN = frozenset({"/livez"})
PROBES = frozenset({"/readyz", "/healthz"})
"""Kubernetes asks these and can send no secret."""
MAX_BODY_BYTES = 64 * 1024
BODY_TIMEOUT_S = 10.0
TRUSTED = "tandem.trusted"
"""Key of the scope: whether who asks may know why something is not well."""
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_HEADERS = {
    "x-content-type-options": "nosniff",
    "content-security-policy": "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}
"""Set where an answer has none of its own."""
_BASIC = 'Basic realm="tandem", charset="UTF-8"'
"""In a header of its own: behind another challenge in the same header Chromium does not see it, and asks nobody."""
_logger = logging.getLogger(__name__)

Observer = Callable[[str, str, int, float], None]
"""Is told method, route template, status, and seconds until the answer began."""


class Guard:
    """ASGI middleware; see the module."""

    def __init__(self, app: ASGIApp, *, token: str | None, public: bool, observe: Observer) -> None:
        """``public``: this service can be reached from other machines, so there has to be a token."""
        assert token is not None or not public
        self._app, self._token, self._public, self._observe = app, token, public, observe

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or pass on what may be answered."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif scope["type"] == "http":
            await self._http(scope, receive, send)
        else:  # a web socket, of which there are none
            await send({"type": "websocket.close", "code": 1008})

    async def _http(self, scope: Scope, receive: Receive, send: Send) -> None:
        inner = dict(scope)  # uvicorn and the router both write into theirs
        if scope["method"] == "HEAD" and not scope["path"].endswith("/stream"):
            inner["method"] = "GET"  # uvicorn leaves the body out
        begun_s, status = time.perf_counter(), 0

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
                if status == HTTPStatus.UNAUTHORIZED and scope["method"] in _SAFE:
                    headers.append("www-authenticate", _BASIC)
                self._observe(scope["method"], _template(inner), status, time.perf_counter() - begun_s)
            await send(message)

        try:
            await self._admitted(inner, receive, answer)
        except ProblemError as problem:
            await problem.response()(inner, receive, answer)
        except Exception:
            # not the message: it may quote the request
            _logger.exception("%s %s failed", scope["method"], _template(inner))
            if status:  # the answer has begun: breaking it off is all that is left
                raise
            unforeseen = ProblemError(500, "failed", "an unforeseen error; the log of the service has more")
            await unforeseen.response()(inner, receive, answer)

    async def _admitted(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope)
        if not self._public and not is_loopback(_host_of(headers.get("host", ""))):
            # a web site whose name leads to 127.0.0.1 must not read what is meant for this machine alone
            raise ProblemError(
                421, "wrong-host", "ask for localhost or 127.0.0.1: this service is for its machine alone"
            )
        scope[TRUSTED] = self._check(scope["method"], scope["path"], headers.get("authorization"))
        if "content-length" in headers or "transfer-encoding" in headers:
            receive = _replay(await _read_body(headers, receive), receive)
        await self._app(scope, receive, send)

    def _check(self, method: str, path: str, authorization: str | None) -> bool:
        """Whether who asks is trusted, if he may ask at all."""
        safe = method in _SAFE
        if safe and path in OPEN:
            return False
        if self._token is None:
            if safe:
                return True
            raise ProblemError(
                403, "read-only", f"this service has no token and so changes nothing; start it with {VARIABLE} set"
            )
        verdict = judge(authorization, self._token, basic=safe)
        if verdict == "right" or (verdict == "missing" and safe and not self._public):
            return True
        if verdict == "missing" and safe and path in PROBES:
            return False
        what = "a token is needed" if verdict == "missing" else "wrong token"
        raise ProblemError(
            401,
            f"{verdict}-token",
            f"{what}: send the header 'Authorization: Bearer TOKEN' with the one this service was started with",
            {"WWW-Authenticate": 'Bearer realm="tandem"'},
        )


def is_loopback(host: str) -> bool:
    """Whether a host's name or address, without a port, means this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _host_of(header: str) -> str:
    """``127.0.0.1:8321`` to ``127.0.0.1``, ``[::1]:8321`` to ``::1``."""
    if header.startswith("["):
        return header[1:].partition("]")[0]
    return header.partition(":")[0]


def _template(scope: Scope) -> str:
    """A route such as ``/v1/runs/{run_id}``; one word for all that came to none."""
    route = scope.get("route")
    return str(getattr(route, "path", "")) or "other"


async def _read_body(headers: Headers, receive: Receive) -> bytes:
    """The whole body, so that no route can be made to take a longer one."""
    declared = headers.get("content-length", "0")
    too_large = ProblemError(413, "too-large", f"a body may have {MAX_BODY_BYTES} bytes; this API needs far fewer")
    if not declared.isdecimal() or int(declared) > MAX_BODY_BYTES:
        raise too_large
    body = b""
    try:
        async with asyncio.timeout(BODY_TIMEOUT_S):
            while True:
                message = await receive()
                body += bytes(message.get("body", b""))
                if len(body) > MAX_BODY_BYTES:
                    raise too_large
                if not message.get("more_body", False):
                    return body
    except TimeoutError:
        raise ProblemError(408, "too-slow", f"the body did not come within {BODY_TIMEOUT_S:g} s") from None


def _replay(body: bytes, receive: Receive) -> Receive:
    first = True

    async def again() -> Message:
        nonlocal first
        if first:
            first = False
            return {"type": "http.request", "body": body, "more_body": False}
        return await receive()

    return again
