"""The ASGI app of the status service, used by ``tandem serve`` and by the Ray actor of a run."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from fastapi import FastAPI, Request
from starlette.responses import Response
from starlette.staticfiles import StaticFiles

from service.base.errors import StatusError
from service.base.version import __version__
from service.registry.registry import Registry
from service.registry.token import VARIABLE, check_token
from service.status import problems
from service.status.api_primitives import primitives_router
from service.status.api_runs import runs_router
from service.status.api_service import service_router
from service.status.auth import AuthMiddleware
from service.status.files import RunDirectories, file_response
from service.status.metrics import Telemetry
from service.status.openapi import COMMON, DESCRIPTION, SECURITY, DocumentedApp
from service.status.problems import ProblemError
from service.status.stream import Streams
from service.store.models import RunReader

PAGE = Path(__file__).parent / "page"
"""Directory of the web page: ``index.html`` is served at ``/``, all files under ``/page/``."""


def create_app(
    runs: RunReader,
    registry: Registry,
    *,
    token: str | None,
    public: bool,
    runs_dir: Path | None = None,
) -> FastAPI:
    """Make the app with the REST API, ``/metrics`` and the web page.

    Requests that change something need the token; if ``public``, so that other machines can reach the service, all do.
    If not public, only requests for localhost are answered. ``runs_dir`` has the pictures and videos of runs. The
    server closes ``app.state.streams`` when it stops.

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
    app.include_router(service_router(runs, registry, telemetry, token))
    app.include_router(runs_router(runs, streams, RunDirectories(runs_dir), registry.root), dependencies=SECURITY)
    app.include_router(primitives_router(registry), dependencies=SECURITY)

    @app.get("/", include_in_schema=False)
    def page(request: Request) -> Response:
        return file_response(request, PAGE / "index.html", "text/html")

    @app.get("/page/plotly.js", include_in_schema=False)
    def plotly(request: Request) -> Response:
        return file_response(request, _plotly(), "text/javascript")

    app.mount("/page", StaticFiles(directory=PAGE))
    problems.add_handlers(app)
    app.add_middleware(AuthMiddleware, token=token, public=public, observe=telemetry.observe)
    return app


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
