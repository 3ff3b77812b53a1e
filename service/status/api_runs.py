"""Routes ``/v1/runs``, ``/v1/series`` and ``/v1/downstream``: progress of runs, and stopping them."""

# no postponed annotations: FastAPI could not resolve a dependency that is local to a function
from collections.abc import AsyncIterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import msgspec
from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi import Path as InPath
from fastapi.responses import StreamingResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from service.base.errors import StoreError
from service.status import run_details, series
from service.status.files import BYTES, PARTS, RUN_FILES, file_response, find_file, kind_of, run_files
from service.status.problems import INVALID, READ_ONLY, UNAVAILABLE, UNKNOWN_RUN, ProblemError, problems
from service.status.schemas import (
    Axis,
    GoalFrames,
    MetricHistory,
    RunFiles,
    RunList,
    RunLog,
    RunSetup,
    SeriesSet,
    TaskTable,
)
from service.status.stream import EVENT_SCHEMA, RunFollower, Streams
from service.status.task_table import task_table
from service.store.models import ACTIVE, RUN_ID, GoalGrid, RunReader, RunStatus

MAX_ITERATION = 2**53 - 1
MAX_SERIES_RUNS = 200
_SPARKLINE_POINTS = 40
_MAX_SPARKLINES = 2000
_Run = Annotated[str, InPath(pattern=RUN_ID, description="id of a run", examples=["cube"])]
_Metric = Annotated[str, Query(min_length=1, max_length=128)]
_Names = Annotated[
    list[_Metric] | None,
    Query(max_length=100, description="of metrics, repeatable; all if left out", examples=[["bob/success_rate"]]),
]
_After = Annotated[int, Query(ge=0, le=MAX_ITERATION, description="only later iterations")]
_Runs = Annotated[
    list[Annotated[str, Query(pattern=RUN_ID)]],
    Query(alias="runs", min_length=1, max_length=MAX_SERIES_RUNS, description="ids, repeatable", examples=[["cube"]]),
]
_SeriesNames = Annotated[
    list[_Metric],
    Query(min_length=1, max_length=100, description="of metrics, repeatable", examples=[["bob/success_rate"]]),
]
_Bound = Annotated[float | None, Query(ge=-1e15, le=1e15, allow_inf_nan=False)]
_MaxPoints = Annotated[int, Query(ge=1, le=10_000, description="down-sample to at most this many points")]


def runs_router(runs: RunReader, streams: Streams, registry: Path) -> APIRouter:
    """Make the routes about runs; ``registry`` is the root of the one that commands name."""
    router = APIRouter(tags=["runs"])
    read = problems(INVALID, UNAVAILABLE)
    errors = problems(UNKNOWN_RUN, INVALID, UNAVAILABLE)

    @lru_cache(_MAX_SPARKLINES)
    def sparkline(run_id: str, names: tuple[str, ...], *_stamp: object) -> tuple[float | None, ...]:
        for name in names:
            values = tuple(runs.sample(run_id, name, _SPARKLINE_POINTS))
            if any(value is not None for value in values):
                return values
        return ()

    @router.get("/v1/runs", summary="All runs", responses=read)
    def list_runs(
        active: Annotated[bool | None, Query(description="only runs in progress, or only those that ended")] = None,
        limit: Annotated[int, Query(ge=1, le=1000)] = 100,
        sparkline_of: Annotated[
            list[_Metric] | None,
            Query(
                alias="sparkline",
                max_length=10,
                description="a metric to give in a few points for each run; of several, the first that it has",
            ),
        ] = None,
        downstream: Annotated[bool | None, Query(description="only runs that learn a task, or only others")] = None,
    ) -> RunList:
        """Active ones first, and each newest start first."""
        found = [
            run
            for run in runs.runs()
            if (active is None or (run.state in ACTIVE) == active)
            and (downstream is None or (run.trial is not None) == downstream)
        ]
        found.sort(key=lambda run: run.state not in ACTIVE)  # the limit must not hide a run that goes on
        sparklines = {}
        for run in found[:limit] if sparkline_of else ():
            with suppress(StoreError):  # it may be deleted just now
                sparklines[run.run_id] = sparkline(run.run_id, tuple(sparkline_of or ()), run.started, run.iteration)
        return RunList(runs=tuple(found[:limit]), num_runs=len(found), sparklines=sparklines)

    @router.get("/v1/runs/{run_id}", summary="One run", responses=errors)
    def get_run(run_id: _Run) -> RunStatus:
        """State, progress, rates, policy lag, actors with their heartbeats, the last error."""
        return runs.run(run_id)

    @router.get("/v1/runs/{run_id}/metrics", summary="A run's metrics so far", responses=errors)
    def get_metrics(
        run_id: _Run, names: _Names = None, after_iteration: _After = 0, max_points: _MaxPoints = 1000
    ) -> MetricHistory:
        """In columns. For new records, ask again with `after_iteration=last_iteration`, or use `metrics/stream`."""
        return series.history(runs, run_id, names, after_iteration, max_points)

    async def follow(
        run_id: _Run,
        names: _Names = None,
        after_iteration: Annotated[
            int | None,
            Query(ge=0, le=MAX_ITERATION, description="begin after it; with the newest if left out"),
        ] = None,
        last_event_id: Annotated[
            int | None,
            Header(ge=0, le=MAX_ITERATION, description="sent by browsers; overrides after_iteration"),
        ] = None,
    ) -> AsyncIterator[RunFollower]:
        # a dependency, because an error in the route itself would come after the headers of the answer
        after = after_iteration if last_event_id is None else last_event_id
        async with streams.follow(run_id, names, after) as follower:
            yield follower

    @router.get(
        "/v1/runs/{run_id}/metrics/stream",
        summary="Events of a run in progress",
        response_class=EventSourceResponse,
        responses={
            **errors,
            200: {"description": "Server-sent events.", "content": {"text/event-stream": {"itemSchema": EVENT_SCHEMA}}},
        },
    )
    async def stream_metrics(follower: Annotated[RunFollower, Depends(follow)]) -> AsyncIterator[ServerSentEvent]:
        """Server-sent events `metrics`, `status`, `reset`, `unavailable` and `end`; docs/api.md describes them."""
        async for event in streams.events(follower):
            yield event

    @router.get(
        "/v1/runs/{run_id}/goals",
        summary="The task generator's grid of goals",
        responses=problems((404, "There is no such run, or it has no grid yet."), INVALID, UNAVAILABLE),
    )
    def get_goals(run_id: _Run) -> GoalGrid:
        """The cells in which a valid goal was ever proposed."""
        grid = runs.goals(run_id)
        if grid is None:
            raise ProblemError(
                404, "no-goals-yet", f"run {run_id} has no goal grid yet; a run writes it every few seconds"
            )
        return grid

    @router.get("/v1/runs/{run_id}/goals/history", summary="How goals and their difficulty changed", responses=errors)
    def get_goal_history(run_id: _Run, frames: Annotated[int, Query(ge=1, le=60)] = 24) -> GoalFrames:
        """From the sample of goals that a run records: cells, and how often Bob reached their goals, part by part."""
        runs.run(run_id)
        return run_details.goal_frames(runs.directory(run_id), runs.goals(run_id), frames)

    @router.get("/v1/runs/{run_id}/setup", summary="A run's configuration and commands", responses=errors)
    def get_setup(run_id: _Run) -> RunSetup:
        """The resolved configuration, the directory, and the commands that stop the run, resume it or use it."""
        return run_details.setup(runs.run(run_id), runs.directory(run_id), registry)

    @router.get("/v1/runs/{run_id}/log", summary="What happened to a run", responses=errors)
    def get_log(run_id: _Run, limit: Annotated[int, Query(ge=1, le=10_000)] = 500) -> RunLog:
        """Who died, who came back, what went wrong, and what its processes said, oldest first."""
        runs.run(run_id)
        return run_details.log(runs.directory(run_id), limit)

    @router.post(
        "/v1/runs/{run_id}/stop",
        summary="Ask a run to end",
        status_code=202,
        responses={**errors, **problems(READ_ONLY)},
    )
    def stop_run(run_id: _Run) -> RunStatus:
        """The run ends after its current iteration, saved, and can be resumed. No effect on one that has ended."""
        runs.request_stop(run_id)
        return runs.run(run_id)

    @router.get("/v1/runs/{run_id}/files", summary="A run's pictures and videos", responses=errors)
    def list_files(run_id: _Run) -> RunFiles:
        """The files that exist at the moment."""
        runs.run(run_id)
        return RunFiles(files=tuple(run_files(runs.directory(run_id), run_id)))

    @router.get(
        "/v1/runs/{run_id}/files/{file}",
        summary="A picture or a video",
        response_class=Response,
        responses={
            **problems((404, "There is no such run or file."), INVALID, UNAVAILABLE),
            **PARTS,
            200: {"description": "The file.", "content": {kind: BYTES for _, kind in RUN_FILES.values()}},
        },
    )
    def get_file(request: Request, run_id: _Run, file: Annotated[str, InPath(max_length=64)]) -> Response:
        """With ranges and an entity tag."""
        runs.run(run_id)
        path = find_file(runs.directory(run_id), run_id, file)
        return file_response(request, path, kind_of(file)[1], cache="private, no-cache")

    @router.get(
        "/v1/runs/{run_id}/video",
        summary="The newest video of a run",
        response_class=Response,
        responses={
            **problems((404, "There is no such run, or no video yet."), INVALID, UNAVAILABLE),
            **PARTS,
            200: {"description": "H.264.", "content": {"video/mp4": BYTES}},
        },
    )
    def get_video(request: Request, run_id: _Run) -> Response:
        """Alice beside Bob, random skills, or episodes of a downstream task: the first that `files` lists."""
        names = [file.name for file in run_files(runs.directory(run_id), run_id) if file.media_type == "video/mp4"]
        return get_file(request, run_id, names[0] if names else "rounds.mp4")

    @router.get("/v1/downstream", summary="Success of methods on downstream tasks", responses=problems(UNAVAILABLE))
    def get_downstream() -> TaskTable:
        """From the runs that learn a task: each cell is a mean over seeds, with its interval."""
        return task_table(runs.runs(), runs.directories())

    @router.get(
        "/v1/series",
        summary="Curves of runs, thinned",
        response_class=Response,
        response_model=None,
        responses={200: {"model": SeriesSet, "description": "The curves."}, **read},
    )
    def get_series(
        run_ids: _Runs,
        names: _SeriesNames,
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
        "/v1/series.csv",
        summary="All values of metrics",
        response_class=Response,
        responses={200: {"content": {"text/csv": {"schema": {"type": "string"}}}, "description": "CSV."}, **read},
    )
    def get_table(run_ids: _Runs, names: _SeriesNames) -> StreamingResponse:
        """A line for every iteration of every run, whole: `run`, `iteration`, `env_steps` and the metrics."""
        headers = {"content-disposition": 'attachment; filename="metrics.csv"'}
        return StreamingResponse(series.table(runs, run_ids, names), media_type="text/csv", headers=headers)

    return router
