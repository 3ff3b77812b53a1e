"""ASGI middleware before every route: who may ask, from where, how large a body, and with which headers.

A new route cannot forget its token: everything needs it except what ``OPEN`` lists. The table "Access" of docs/api.md
says who may do what. GET also takes the token as the password of HTTP Basic, so that a browser can show the page.
Requests that change something do not: any web site could make such a browser send them.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import re
import time
from collections.abc import Callable
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie

from anyio import BrokenResourceError
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.status.problems import ProblemError
from service.status.token import SESSION_COOKIE, VARIABLE, check_authorization, check_session

OPEN = frozenset({"/livez", "/"})
OPEN_FOLDER = "/page/"
"""The page itself, which holds no secret: it asks for the token, and then for what is to be seen."""
SESSION = "/v1/session"
"""Takes the token in the body."""
PROBES = frozenset({"/readyz", "/healthz"})
"""Paths for Kubernetes, which cannot send a secret."""
MAX_BODY_BYTES = 64 * 1024
BODY_TIMEOUT_S = 10.0
TRUSTED = "tandem.trusted"
"""Key of the ASGI scope: whether the client may know why something is not ready."""
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_HEADERS = {
    "x-content-type-options": "nosniff",
    # plotly makes style rules by code, and pictures from what it drew
    "content-security-policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}
"""Headers of every answer that does not set them itself."""
_HOST = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([^:@/\[\]\s]+))(?::[0-9]{1,5})?")
_BASIC = 'Basic realm="tandem", charset="UTF-8"'
"""Sent as a header of its own: Chromium ignores it behind another challenge in the same header."""
_logger = logging.getLogger(__name__)


class AuthMiddleware:
    """Authentication, limits, security headers and the last error handler.

    A ``public`` service has a token. ``observe`` is `Telemetry.observe`.
    """

    def __init__(self, app: ASGIApp, *, token: str | None, public: bool, observe: Callable[..., None]) -> None:
        assert token is not None or not public
        self._app, self._token, self._public, self._observe = app, token, public, observe

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer the HTTP request, or pass it on if it is allowed; the server passes on nothing else."""
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
                if status == HTTPStatus.UNAUTHORIZED and scope["method"] in _SAFE and not _by_script(scope):
                    headers.append("www-authenticate", _BASIC)
                self._observe(scope["method"], _template(inner), status, time.perf_counter() - begun_s)
            await send(message)

        try:
            await self._pass_on(inner, receive, answer)
        except ProblemError as problem:
            await problem.response()(inner, receive, answer)
        except Exception as error:
            if status and _is_of_a_closed_connection(error):
                return
            # without the error's message, which may quote the request
            _logger.exception("%s %s failed", scope["method"], _template(inner))
            if status:  # the answer has begun; all that is left is to break it off
                raise
            unexpected = ProblemError(500, "failed", "an unforeseen error; the log of the service has more")
            await unexpected.response()(inner, receive, answer)

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check a request and pass it on, or raise ``ProblemError``."""
        headers = Headers(scope=scope)
        if not self._public and not is_loopback(_host(headers.get("host", ""))):
            # otherwise a web site whose name resolves to 127.0.0.1 could read this service
            raise ProblemError(
                421, "wrong-host", "ask for localhost or 127.0.0.1: this service is for its machine alone"
            )
        scope[TRUSTED] = self._is_trusted(scope["method"], scope["path"], headers)
        if "content-length" in headers or "transfer-encoding" in headers:
            receive = _replay(await _read_body(headers, receive), receive)
        await self._app(scope, receive, send)

    def _is_trusted(self, method: str, path: str, headers: Headers) -> bool:
        """Whether an allowed request may see everything; raises ``ProblemError`` for one that is not allowed."""
        safe = method in _SAFE
        if (safe and (path in OPEN or path.startswith(OPEN_FOLDER))) or path == SESSION:
            return False
        if self._token is None:
            if safe:
                return True
            raise ProblemError(
                403, "read-only", f"this service has no token and so changes nothing; start it with {VARIABLE} set"
            )
        verdict = check_authorization(headers.get("authorization"), self._token, basic=safe)
        if verdict == "missing" and safe and check_session(_cookie(headers), self._token):
            return True
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
    """Whether a host name or address, without a port, means this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _host(header: str) -> str:
    """The host of a Host header: ``127.0.0.1`` of ``127.0.0.1:8321``, ``::1`` of ``[::1]:8321``; empty if malformed."""
    found = _HOST.fullmatch(header)
    return "" if found is None else found[1] or found[2]


def _is_of_a_closed_connection(error: BaseException) -> bool:
    """Whether all that went wrong is that a stream of events was cut off by its client."""
    if isinstance(error, BaseExceptionGroup):
        return all(map(_is_of_a_closed_connection, error.exceptions))
    return isinstance(error, BrokenResourceError)


def _cookie(headers: Headers) -> str | None:
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(SESSION_COOKIE)
    except CookieError:
        return None
    return found.value if found is not None else None


def _by_script(scope: Scope) -> bool:
    """Whether a page's script asks, which has a form of its own: for a challenge, browsers open a window before it."""
    return Headers(scope=scope).get("sec-fetch-mode", "navigate") != "navigate"


def _template(scope: Scope) -> str:
    """The template of the request's route, such as ``/v1/runs/{run_id}``; "other" if there is no route."""
    return str(getattr(scope.get("route"), "path", "")) or "other"


async def _read_body(headers: Headers, receive: Receive) -> bytes:
    """Read the whole body, so that the limits hold for every route."""
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
    """A ``receive`` that gives a body that was read already."""
    messages: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return messages.pop() if messages else await receive()

    return replay
