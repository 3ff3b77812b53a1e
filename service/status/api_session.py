"""Route ``/v1/session``: the page's form to log in, which gives a browser a cookie that reads."""

from __future__ import annotations

import hmac

from fastapi import APIRouter, Request, Response

from service.registry.token import SESSION_COOKIE, session_secret
from service.status.openapi import INVALID, problems
from service.status.problems import ProblemError
from service.status.schemas import Session, TokenEntry

SESSION_S = 7 * 24 * 3600


def session_router(token: str | None) -> APIRouter:
    """Make the route that opens a session."""
    router = APIRouter(prefix="/v1", tags=["health"])

    @router.post(
        "/session",
        summary="Log a browser in",
        responses=problems(INVALID, (403, "This service has no token and so changes nothing.")),
    )
    async def open_session(entry: TokenEntry, request: Request, response: Response) -> Session:
        """Sets a cookie for this browser, with which it may read; it does not hold the token, and ends with it."""
        if token is None:
            raise ProblemError(403, "read-only", "this service has no token: everybody on its machine may read")
        if not hmac.compare_digest(entry.token.strip().encode(), token.encode()):
            said = "wrong token: enter the one that this service was started with"
            raise ProblemError(401, "wrong-token", said, {"WWW-Authenticate": 'Bearer realm="tandem"'})
        response.set_cookie(
            SESSION_COOKIE,
            session_secret(token),
            max_age=SESSION_S,
            httponly=True,
            samesite="strict",
            secure=request.headers.get("x-forwarded-proto") == "https",
        )
        return Session(status="open")

    return router
