"""Routes ``/livez``, ``/readyz``, ``/healthz`` and ``/metrics``."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from service.base.errors import TandemError
from service.registry.registry import Registry
from service.status.auth import TRUSTED
from service.status.metrics import CONTENT_TYPE, Telemetry
from service.status.openapi import problems
from service.status.problems import ProblemError
from service.status.schemas import Alive, Ready
from service.store.models import RunReader

_NOT_READY = problems((503, "The runs or the registry cannot be read; the reason is given only with the token."))


def health_router(runs: RunReader, registry: Registry, telemetry: Telemetry) -> APIRouter:
    """Make the routes for monitoring."""
    router = APIRouter(tags=["health"])

    @router.get("/livez", summary="Whether the service answers")
    async def livez() -> Alive:  # in the event loop: the threads may all wait for a file
        """Needs no files and no Redis: a service that answers this need not be restarted."""
        return Alive()

    @router.get("/readyz", summary="Whether runs and registry can be read", responses=_NOT_READY)
    def readyz(request: Request) -> Ready:
        """503 while something the service needs is unavailable."""
        try:
            runs.ready()
            registry.names()
        except (TandemError, OSError) as error:
            trusted = request.scope.get(TRUSTED, False)
            raise ProblemError(
                503, "not-ready", str(error) if trusted else "not ready; ask with the token why"
            ) from None
        return Ready()

    @router.get("/healthz", summary="The same as /readyz", responses=_NOT_READY)
    def healthz(request: Request) -> Ready:
        """An older name of /readyz."""
        return readyz(request)

    @router.get(
        "/metrics",
        summary="For Prometheus",
        response_class=Response,
        responses={
            200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "Prometheus' text format"}
        },
    )
    def metrics() -> Response:
        """Metrics of active and recently ended runs, the registry, and this service; see docs/operations.md."""
        return Response(telemetry.page(), media_type=CONTENT_TYPE)

    return router
