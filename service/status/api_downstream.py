"""Route ``/v1/downstream``: the table of runs that learn a task."""

from __future__ import annotations

from fastapi import APIRouter

from service.status.files import RunDirectories
from service.status.openapi import UNAVAILABLE, problems
from service.status.schemas import TaskTable
from service.status.task_table import task_table
from service.store.models import RunReader


def downstream_router(runs: RunReader, directories: RunDirectories) -> APIRouter:
    """Make the route of the table."""
    router = APIRouter(prefix="/v1", tags=["runs"])

    @router.get("/downstream", summary="Success of methods on downstream tasks", responses=problems(UNAVAILABLE))
    def get_downstream() -> TaskTable:
        """From the runs that learn a task: each cell is a mean over seeds, with its interval."""
        return task_table(runs.runs(), directories.directories())

    return router
