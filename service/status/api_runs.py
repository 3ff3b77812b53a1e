"""``/v1/runs``: how runs go, and stopping them."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi import Path as InPath
from fastapi.responses import StreamingResponse

from service.status.files import BYTES, PARTS, RUN_FILES, RunDirectories, file_response
from service.status.history import Histories
from service.status.openapi import AWAY, INVALID, UNKNOWN_RUN, problems
from service.status.problems import ProblemError
from service.status.shapes import MetricHistory, RunFiles, RunList
from service.status.stream import EVENT_SCHEMA, Streams
from service.store.models import ACTIVE, GoalGrid, RunReader, RunStatus

MAX_ITERATION = 2**53 - 1
_VIDEO = "rounds.mp4"
_Run = Annotated[
    str,
    InPath(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,127}$", description="id of a run", examples=["cube"]),
]
_Metric = Annotated[str, Query(min_length=1, max_length=128)]
_Names = Annotated[
    list[_Metric] | None,
    Query(max_length=100, description="of metrics, repeatable; all when left out", examples=[["bob/success_rate"]]),
]
_After = Annotated[int, Query(ge=0, le=MAX_ITERATION, description="only later iterations")]
_MaxPoints = Annotated[int, Query(ge=1, le=10_000, description="down-sample to so many points")]


def runs_router(runs: RunReader, histories: Histories, streams: Streams, directories: RunDirectories) -> APIRouter:
    """Routes about runs."""
    router = APIRouter(prefix="/v1/runs", tags=["runs"])
    errors = problems(UNKNOWN_RUN, INVALID, AWAY)

    @router.get("", summary="All runs", responses=problems(INVALID, AWAY))
    def list_runs(
        active: Annotated[bool | None, Query(description="only those that go on, or only the others")] = None,
        limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    ) -> RunList:
        """Newest start first."""
        found = [run for run in runs.runs() if active is None or (run.state in ACTIVE) == active]
        return RunList(runs=tuple(found[:limit]), num_runs=len(found))

    @router.get("/{run_id}", summary="One run", responses=errors)
    def get_run(run_id: _Run) -> RunStatus:
        """State, progress, rates, policy lag, actors with their heartbeats, the last error."""
        return runs.run(run_id)

    @router.get("/{run_id}/metrics", summary="A run's metrics so far", responses=errors)
    def get_metrics(
        run_id: _Run, names: _Names = None, after_iteration: _After = 0, max_points: _MaxPoints = 1000
    ) -> MetricHistory:
        """In columns. Asking for those after `last_iteration` gives what is new; or listen to `metrics/stream`."""
        return histories.history(run_id, names, after_iteration, max_points)

    @router.get(
        "/{run_id}/metrics/stream",
        summary="A run while it goes on",
        response_class=StreamingResponse,
        responses={
            **errors,
            200: {
                "description": "Server-sent events.",
                "content": {"text/event-stream": {"schema": EVENT_SCHEMA}},
            },
        },
    )
    async def stream_metrics(
        run_id: _Run,
        names: _Names = None,
        after_iteration: Annotated[
            int | None, Query(ge=0, le=MAX_ITERATION, description="begin after it; with the newest when left out")
        ] = None,
        last_event_id: Annotated[
            int | None, Header(ge=0, le=MAX_ITERATION, description="counts before after_iteration; browsers send it")
        ] = None,
    ) -> StreamingResponse:
        """Server-sent events `metrics`, `status`, `reset`, `unavailable` and `end`; docs/api.md tells of each."""
        after = after_iteration if last_event_id is None else last_event_id
        return StreamingResponse(await streams.open(run_id, names, after), media_type="text/event-stream")

    @router.get(
        "/{run_id}/goals",
        summary="What the task generator knows about goals",
        responses=problems((404, "There is no such run, or it has no grid yet."), INVALID, AWAY),
    )
    def get_goals(run_id: _Run) -> GoalGrid:
        """The cells of its grid in which a valid goal was ever proposed."""
        grid = runs.goals(run_id)
        if grid is None:
            raise ProblemError(
                404, "no-goals-yet", f"run {run_id} has no goal grid yet; a run writes it every few seconds"
            )
        return grid

    @router.post(
        "/{run_id}/stop",
        summary="Ask a run to end",
        status_code=202,
        responses={**errors, **problems((409, "It takes no requests."))},
    )
    def stop_run(run_id: _Run) -> RunStatus:
        """It ends after its current iteration, saved, and can be resumed. One that has ended stays as it is."""
        runs.request_stop(run_id)
        return runs.run(run_id)

    @router.get("/{run_id}/files", summary="A run's pictures and videos", responses=errors)
    def list_files(run_id: _Run) -> RunFiles:
        """Those there are at the moment."""
        runs.run(run_id)
        return RunFiles(files=tuple(directories.files(run_id)))

    @router.get(
        "/{run_id}/files/{file}",
        summary="A picture or a video",
        response_class=Response,
        responses={
            **problems((404, "There is no such run or file."), INVALID, AWAY),
            **PARTS,
            200: {"description": "The file.", "content": {kind: BYTES for _, kind in RUN_FILES.values()}},
        },
    )
    def get_file(request: Request, run_id: _Run, file: Annotated[str, InPath(max_length=64)]) -> Response:
        """In ranges, too; with an entity tag."""
        runs.run(run_id)
        path = directories.path(run_id, file)
        return file_response(request, path, RUN_FILES[file][1], cache="private, no-cache")

    @router.get(
        "/{run_id}/video",
        summary="The newest video of a run",
        response_class=Response,
        responses={
            **problems((404, "There is no such run, or no video yet."), INVALID, AWAY),
            **PARTS,
            200: {"description": "H.264.", "content": {"video/mp4": BYTES}},
        },
    )
    def get_video(request: Request, run_id: _Run) -> Response:
        """Alice beside Bob; the same as `files/rounds.mp4`."""
        return get_file(request, run_id, _VIDEO)

    return router
