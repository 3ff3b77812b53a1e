"""ASGI middleware before every route: who may ask, from where, how large a body, and with which headers.

A new route cannot forget its token: everything needs it except what ``OPEN`` lists. The table "Access" of docs/api.md
says who may do what. Slow clients and floods are kept away by the proxy in front, deploy/nginx.
"""

from __future__ import annotations

import ipaddress
import logging
import re
import time
from collections.abc import Callable

from anyio import BrokenResourceError
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.registry.token import SESSION_COOKIE, VARIABLE, check_authorization, check_session
from service.status.problems import ProblemError

OPEN = frozenset({"/livez", "/"})
OPEN_FOLDER = "/page/"
"""The page itself, which holds no secret: it asks for the token, and then for what is to be seen."""
SESSION = "/v1/session"
"""Takes the token in the body."""
PROBE = "/readyz"
"""For Kubernetes, which cannot send a secret."""
MAX_BODY_BYTES = 64 * 1024
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
}
"""Headers of every answer."""
_LONG = ("/stream", "/v1/series.csv")
"""Ends of paths whose answers are made piece by piece, for as long as the client is there."""
_HOST = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([^:@/\[\]\s]+))(?::[0-9]{1,5})?")
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
        if not scope["path"].endswith(_LONG):
            # or Starlette listens for the end of the client while it sends a file, and uvicorn reads on meanwhile
            inner["asgi"] = {**scope["asgi"], "spec_version": "2.4"}
        if scope["method"] == "HEAD" and not scope["path"].endswith("/stream"):
            inner["method"] = "GET"  # uvicorn leaves the body out
        begun_s, status = time.perf_counter(), 0

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers.update(_HEADERS)
                # browsers revalidate the page each time, so that after an update none shows a mix of old and new files
                headers.setdefault("cache-control", "no-cache" if scope["path"].startswith(OPEN_FOLDER) else "no-store")
                self._observe(scope["method"], _template(inner), status, time.perf_counter() - begun_s)
            await send(message)

        try:
            inner[TRUSTED] = self._is_trusted(HTTPConnection(inner), scope["method"], scope["path"])
            await self._app(inner, _bounded(receive), answer)
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

    def _is_trusted(self, request: HTTPConnection, method: str, path: str) -> bool:
        """Whether an allowed request may see everything; raises ``ProblemError`` for one that is not allowed."""
        if not self._public and not is_loopback(_host(request.headers.get("host", ""))):
            # otherwise a web site whose name resolves to 127.0.0.1 could read this service
            raise ProblemError(
                421, "wrong-host", "ask for localhost or 127.0.0.1: this service is for its machine alone"
            )
        safe = method in _SAFE
        if (safe and (path in OPEN or path.startswith(OPEN_FOLDER))) or path == SESSION:
            return False
        if self._token is None:
            if safe:
                return True
            raise ProblemError(
                403, "read-only", f"this service has no token and so changes nothing; start it with {VARIABLE} set"
            )
        verdict = check_authorization(request.headers.get("authorization"), self._token)
        if verdict == "right":
            return True
        if verdict == "missing" and safe:
            if not self._public or check_session(request.cookies.get(SESSION_COOKIE), self._token):
                return True
            if path == PROBE:
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


def _template(scope: Scope) -> str:
    """The template of the request's route, such as ``/v1/runs/{run_id}``; "other" if there is no route."""
    return str(getattr(scope.get("route"), "path", "")) or "other"


def _bounded(receive: Receive) -> Receive:
    """A ``receive`` that ends the request with 413 once more than ``MAX_BODY_BYTES`` of its body have come."""
    num_bytes = 0

    async def bounded() -> Message:
        nonlocal num_bytes
        message = await receive()
        num_bytes += len(message.get("body", b""))
        if num_bytes > MAX_BODY_BYTES:
            raise HTTPException(413, f"a body may have {MAX_BODY_BYTES} bytes; this API needs far fewer")
        return message

    return bounded
