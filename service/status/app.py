"""The ASGI app of the status service, used by ``tandem serve`` and by the Ray actor of a run."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from starlette.responses import Response
from starlette.staticfiles import StaticFiles

from service.base.errors import StatusError
from service.base.version import __version__
from service.registry.registry import Registry
from service.registry.token import VARIABLE, check_token
from service.status import openapi, problems
from service.status.api_downstream import downstream_router
from service.status.api_health import health_router
from service.status.api_primitives import primitives_router
from service.status.api_runs import runs_router
from service.status.api_series import series_router
from service.status.api_session import session_router
from service.status.auth import AuthMiddleware
from service.status.files import RunDirectories, file_response
from service.status.metrics import Telemetry
from service.status.problems import ProblemError
from service.status.stream import Streams
from service.store.models import RunReader

PAGE = Path(__file__).parent / "page"
"""Directory of the web page: ``index.html`` is served at ``/``, all files under ``/page/``."""


class StatusApp(FastAPI):
    """The app; made by ``create_app``."""

    streams: Streams
    """Open event streams; the server closes them when it stops."""
    public: bool

    def openapi(self) -> dict[str, Any]:
        """The OpenAPI document."""
        if self.openapi_schema is None:  # FastAPI keeps the document that it makes here
            openapi.complete(super().openapi(), public=self.public)
        return super().openapi()


def create_app(
    runs: RunReader,
    registry: Registry,
    *,
    token: str | None,
    public: bool,
    runs_dir: Path | None = None,
) -> StatusApp:
    """Make the app with the REST API, ``/metrics`` and the web page.

    Requests that change something need the token; if ``public``, so that other machines can reach the service, all do.
    If not public, only requests for localhost are answered. ``runs_dir`` has the pictures and videos of runs.

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
    app = StatusApp(
        title="Tandem",
        summary="Robot skills, pre-trained: runs, metrics and primitives.",
        description=openapi.DESCRIPTION,
        version=__version__,
        docs_url=None,  # its scripts are loaded from another site
        redoc_url=None,
        redirect_slashes=False,
        generate_unique_id_function=lambda route: route.name,
    )
    app.streams, app.public = streams, public
    app.include_router(health_router(runs, registry, telemetry))
    directories = RunDirectories(runs_dir)
    app.include_router(runs_router(runs, streams, directories, registry.root))
    app.include_router(downstream_router(runs, directories))
    app.include_router(series_router(runs))
    app.include_router(session_router(token))
    app.include_router(primitives_router(registry))

    @app.get("/", include_in_schema=False)
    def page(request: Request) -> Response:
        return file_response(request, PAGE / "index.html", "text/html", cache="no-cache")

    @app.get("/page/plotly.js", include_in_schema=False)
    def plotly(request: Request) -> Response:
        return file_response(request, _plotly(), "text/javascript", cache="no-cache")

    app.mount("/page", _PageFiles(directory=PAGE))
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


class _PageFiles(StaticFiles):
    """Files that browsers revalidate each time, so that after an update none shows a mix of old and new files."""

    def file_response(self, *args: Any, **options: Any) -> Response:
        response = super().file_response(*args, **options)
        response.headers.setdefault("cache-control", "no-cache")
        return response
