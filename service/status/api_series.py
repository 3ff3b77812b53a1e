"""Routes ``/v1/series``: curves of any number of runs, as points for a picture or all of them as CSV."""

from __future__ import annotations

from typing import Annotated

import msgspec
from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse

from service.status import series
from service.status.openapi import INVALID, UNAVAILABLE, problems
from service.status.schemas import Axis, SeriesSet
from service.store.models import RunReader

MAX_RUNS = 200
_Run = Annotated[str, Query(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,127}$")]
_Runs = Annotated[
    list[_Run],
    Query(alias="runs", min_length=1, max_length=MAX_RUNS, description="ids, repeatable", examples=[["cube"]]),
]
_Metric = Annotated[str, Query(min_length=1, max_length=128)]
_Names = Annotated[
    list[_Metric],
    Query(min_length=1, max_length=100, description="of metrics, repeatable", examples=[["bob/success_rate"]]),
]
_Bound = Annotated[float | None, Query(ge=-1e15, le=1e15, allow_inf_nan=False)]


def series_router(runs: RunReader) -> APIRouter:
    """Make the routes that give the same metrics of several runs."""
    router = APIRouter(prefix="/v1", tags=["runs"])
    errors = problems(INVALID, UNAVAILABLE)

    @router.get(
        "/series",
        summary="Curves of runs, thinned",
        response_class=Response,
        response_model=None,
        responses={200: {"model": SeriesSet, "description": "The curves."}, **errors},
    )
    def get_series(
        run_ids: _Runs,
        names: _Names,
        axis: Axis = "env_steps",
        start: _Bound = None,
        end: _Bound = None,
        max_points: Annotated[int, Query(ge=20, le=10_000, description="of each curve")] = 1000,
    ) -> Response:
        """Of a part with more iterations than points, each point has the mean, the lowest and the highest of its own.

        A run that cannot be read has a `problem`, and the others their curves. Fewer points where many are asked for.
        """
        found = series.series(runs, run_ids, names, axis, start, end, max_points)
        return Response(msgspec.json.encode(found), media_type="application/json")

    @router.get(
        "/series.csv",
        summary="All values of metrics",
        response_class=Response,
        responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}}, "description": "CSV."}, **errors},
    )
    def get_table(run_ids: _Runs, names: _Names) -> StreamingResponse:
        """A line for every iteration of every run, whole: `run`, `iteration`, `env_steps` and the metrics."""
        headers = {"content-disposition": 'attachment; filename="metrics.csv"'}
        return StreamingResponse(series.table(runs, run_ids, names), media_type="text/csv", headers=headers)

    return router
