"""Routes about the service itself: is it well, ``/metrics``, and the page's form to log in."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from service.base.errors import TandemError
from service.registry.registry import Registry
from service.registry.token import SESSION_COOKIE, check_authorization, session_secret
from service.status.auth import TRUSTED
from service.status.metrics import CONTENT_TYPE, Telemetry
from service.status.openapi import INVALID, READ_ONLY, SECURITY, problems
from service.status.problems import ProblemError
from service.status.schemas import ServiceState, TokenEntry
from service.store.models import RunReader

SESSION_S = 7 * 24 * 3600
_NOT_READY = problems((503, "The runs or the registry cannot be read; the reason is given only with the token."))


def service_router(runs: RunReader, registry: Registry, telemetry: Telemetry, token: str | None) -> APIRouter:
    """Make the routes for monitoring, and the one that gives a browser a cookie that reads."""
    router = APIRouter(tags=["health"])

    @router.get("/livez", summary="Whether the service answers")
    async def livez() -> ServiceState:  # in the event loop: the threads may all wait for a file
        """Needs no files and no Redis: a service that answers this need not be restarted."""
        return ServiceState(status="alive")

    @router.get("/readyz", summary="Whether runs and registry can be read", responses=_NOT_READY)
    def readyz(request: Request) -> ServiceState:
        """503 while something the service needs is unavailable."""
        try:
            runs.ready()
            registry.names()
        except (TandemError, OSError) as error:
            trusted = request.scope.get(TRUSTED, False)
            raise ProblemError(
                503, "not-ready", str(error) if trusted else "not ready; ask with the token why"
            ) from None
        return ServiceState(status="ready")

    @router.get("/healthz", summary="The same as /readyz", responses=_NOT_READY)
    def healthz(request: Request) -> ServiceState:
        """An older name of /readyz."""
        return readyz(request)

    @router.get(
        "/metrics",
        summary="For Prometheus",
        dependencies=SECURITY,
        response_class=Response,
        responses={
            200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "Prometheus' text format"}
        },
    )
    def metrics() -> Response:
        """Metrics of active and recently ended runs, the registry, and this service; see docs/operations.md."""
        return Response(telemetry.page(), media_type=CONTENT_TYPE)

    @router.post(
        "/v1/session",
        summary="Log a browser in",
        responses=problems(INVALID, READ_ONLY),
    )
    async def open_session(entry: TokenEntry, request: Request, response: Response) -> ServiceState:
        """Sets a cookie for this browser, with which it may read; it does not hold the token, and ends with it."""
        if token is None:
            raise ProblemError(403, "read-only", "this service has no token: everybody on its machine may read")
        if check_authorization(f"Bearer {entry.token}", token) != "right":
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
        return ServiceState(status="open")

    return router
