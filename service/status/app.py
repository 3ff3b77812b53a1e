"""The status service as one ASGI app, for ``tandem serve``, for a thread beside a local run, and for a Ray actor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fastapi import FastAPI
from starlette.responses import FileResponse, Response
from starlette.staticfiles import StaticFiles

import service
from service.registry.registry import Registry
from service.status import openapi, problems
from service.status.answers import AGE_S, Answers
from service.status.api_health import health_router
from service.status.api_primitives import primitives_router
from service.status.api_runs import runs_router
from service.status.errors import StatusError
from service.status.files import RunDirectories
from service.status.guard import Guard
from service.status.history import Histories
from service.status.metrics import Telemetry
from service.status.stream import MAX_AGE_S, Streams
from service.status.token import VARIABLE, check_token
from service.store.models import RunReader

PAGE = Path(__file__).parent / "page"
"""The web page: ``index.html`` is served at ``/``, all there is under ``/page/``."""


class StatusApp(FastAPI):
    """The app; made by ``create_app``."""

    streams: Streams
    """To be closed when the server shuts down, or it would wait for its listeners."""
    public: bool

    def openapi(self) -> dict[str, Any]:
        """The OpenAPI document."""
        if self.openapi_schema is None:
            self.openapi_schema = openapi.document(self, public=self.public)
        return self.openapi_schema


def create_app(
    runs: RunReader,
    registry: Registry,
    *,
    token: str | None,
    public: bool,
    runs_dir: Path | None = None,
    max_stream_s: float = MAX_AGE_S,
    answer_age_s: float = AGE_S,
) -> StatusApp:
    """The REST API, ``/metrics`` and the web page.

    Args:
        runs: where to read runs from.
        registry: of primitives; its root need not exist.
        token: what changes something needs it; where ``public``, everything does.
        public: whether other machines can reach the service. If not, only requests for localhost are answered.
        runs_dir: directory of run directories, for their pictures and videos; None where there are none.
        max_stream_s: how long an event stream may last before its listener has to come back.
        answer_age_s: how long an answer to one may be given to others.

    Raises:
        StatusError: public without a token, or a token that is too short.
    """
    if token is not None:
        check_token(token, "the token")
    elif public:
        raise StatusError(
            f"no token, and other machines can reach this address: set {VARIABLE} or --token-file, or serve 127.0.0.1"
        )
    streams = Streams(runs, max_age_s=max_stream_s)
    telemetry = Telemetry(runs, registry, lambda: streams.num_open)
    app = StatusApp(
        title="Tandem",
        summary="Robot skills, pre-trained: runs, metrics and primitives.",
        description=openapi.DESCRIPTION,
        version=service.__version__,
        docs_url=None,  # its scripts come from another site
        redoc_url=None,
        redirect_slashes=False,
        generate_unique_id_function=lambda route: route.name,
    )
    app.streams, app.public = streams, public
    app.include_router(health_router(runs, registry, telemetry))
    app.include_router(runs_router(runs, Histories(runs), streams, RunDirectories(runs_dir)))
    app.include_router(primitives_router(registry))
    _add_page(app)
    problems.add_handlers(app)
    app.add_middleware(Answers, age_s=answer_age_s)
    app.add_middleware(Guard, token=token, public=public, observe=telemetry.observe)
    return app


def _add_page(app: FastAPI) -> None:
    headers = {"cache-control": "no-cache"}

    @app.get("/", include_in_schema=False)
    def page() -> Response:
        return FileResponse(PAGE / "index.html", headers=headers)

    app.mount("/page", _PageFiles(directory=PAGE))


class _PageFiles(StaticFiles):
    """Asked for anew each time, with their entity tags: after an update nobody sees half of the old page."""

    def file_response(self, *args: Any, **options: Any) -> Response:
        response = super().file_response(*args, **options)
        response.headers.setdefault("cache-control", "no-cache")
        return response
