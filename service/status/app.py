"""The ASGI app of the status service, used by ``tandem serve`` and by the Ray actor of a run.

Its routes about the service itself are here, too: is it well, ``/metrics``, the page, and the page's form to log in.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fastapi import APIRouter, FastAPI, Request, Response, Security
from fastapi.security import APIKeyCookie, HTTPBearer
from starlette.staticfiles import StaticFiles

from service.base.errors import StatusError, TandemError
from service.base.version import __version__
from service.registry.registry import Registry
from service.registry.token import SESSION_COOKIE, VARIABLE, check_authorization, check_token, session_secret
from service.status.api_primitives import primitives_router
from service.status.api_runs import runs_router
from service.status.auth import TRUSTED, AuthMiddleware
from service.status.files import file_response
from service.status.metrics import CONTENT_TYPE, Telemetry
from service.status.problems import COMMON, INVALID, READ_ONLY, Problem, ProblemError, add_handlers, problems
from service.status.schemas import ServiceState, TokenEntry
from service.status.stream import Streams
from service.store.models import RunReader

PAGE = Path(__file__).parent / "page"
"""Directory of the web page: ``index.html`` is served at ``/``, all files under ``/page/``."""
SESSION_S = 7 * 24 * 3600
DESCRIPTION = """
Runs, their progress, and primitives. Errors are `application/problem+json` (RFC 9457).
On a public address every request but `/livez` needs the token; on any address those that change something need it.
"""
SECURITY = [
    Security(HTTPBearer(description="The token the service was started with.", auto_error=False)),
    Security(
        APIKeyCookie(
            name=SESSION_COOKIE, description="Set by POST /v1/session, for browsers; GET only.", auto_error=False
        )
    ),
]
"""Dependencies that only tell how to show the token; ``AuthMiddleware`` asks for it."""
_NOT_READY = problems((503, "The runs or the registry cannot be read; the reason is given only with the token."))


class DocumentedApp(FastAPI):
    """An app whose document has the schema of errors, and parameters that can be left out but are never null."""

    def openapi(self) -> dict[str, Any]:
        """The OpenAPI document."""
        tree = super().openapi()
        problem = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
        tree["components"]["schemas"] |= {"Problem": problem, **problem.pop("$defs")}
        for parameter in (
            each for path in tree["paths"].values() for each in path.get("get", {}).get("parameters", ())
        ):
            schema = parameter["schema"]
            schema |= schema.pop("anyOf", [{}])[0]
        return tree


def create_app(
    runs: RunReader,
    registry: Registry,
    *,
    token: str | None,
    public: bool,
) -> FastAPI:
    """Make the app with the REST API, ``/metrics`` and the web page.

    Requests that change something need the token; if ``public``, so that other machines can reach the service, all do.
    If not public, only requests for localhost are answered. The server closes ``app.state.streams`` when it stops.

    Raises:
        StatusError: public without a token, or a token that is too short.
    """
    if token is not None:
        check_token(token, "the token")
    elif public:
        raise StatusError(
            f"no token, and other machines can reach this address: set {VARIABLE} or --token-file, or serve 127.0.0.1"
        )
    streams = Streams(runs)
    telemetry = Telemetry(runs, registry, lambda: streams.num_open)
    app = DocumentedApp(
        title="Tandem",
        summary="Robot skills, pre-trained: runs, metrics and primitives.",
        description=DESCRIPTION,
        version=__version__,
        docs_url=None,  # its scripts are loaded from another site
        redoc_url=None,
        redirect_slashes=False,
        responses=COMMON,
        generate_unique_id_function=lambda route: route.name,
    )
    app.state.streams = streams
    app.include_router(_service_router(runs, registry, telemetry, token))
    app.include_router(runs_router(runs, streams, registry.root), dependencies=SECURITY)
    app.include_router(primitives_router(registry), dependencies=SECURITY)

    @app.get("/", include_in_schema=False)
    def page(request: Request) -> Response:
        return file_response(request, PAGE / "index.html", "text/html")

    @app.get("/page/plotly.js", include_in_schema=False)
    def plotly(request: Request) -> Response:
        return file_response(request, _plotly(), "text/javascript")

    app.mount("/page", StaticFiles(directory=PAGE))
    add_handlers(app)
    app.add_middleware(AuthMiddleware, token=token, public=public, observe=telemetry.observe)
    return app


def _service_router(runs: RunReader, registry: Registry, telemetry: Telemetry, token: str | None) -> APIRouter:
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
            registry.ready()
        except (TandemError, OSError) as error:
            trusted = request.scope.get(TRUSTED, False)
            raise ProblemError(
                503, "not-ready", str(error) if trusted else "not ready; ask with the token why"
            ) from None
        return ServiceState(status="ready")

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


def _plotly() -> Path:
    """The library that draws curves, in the package plotly, which is not imported for it.

    Raises:
        ProblemError: the package is not installed.
    """
    found = find_spec("plotly")
    path = Path(found.origin or "").parent / "package_data" / "plotly.min.js" if found is not None else None
    if path is None or not path.is_file():
        raise ProblemError(404, "no-plotly", "curves need the package plotly: pip install 'tandem-skills[serve]'")
    return path
