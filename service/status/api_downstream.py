"""Route ``/v1/downstream``: the table of downstream trainings; each of them is a run, as of ``/v1/runs``."""

from __future__ import annotations

from fastapi import APIRouter

from service.status.files import RunDirectories
from service.status.schemas import TaskTable
from service.status.task_table import task_table


def downstream_router(directories: RunDirectories) -> APIRouter:
    """Make the route of the table."""
    router = APIRouter(prefix="/v1", tags=["runs"])

    @router.get("/downstream", summary="Success of methods on downstream tasks")
    def get_downstream() -> TaskTable:
        """From the trainings in the directory of runs: each cell is a mean over seeds, with its interval."""
        return task_table(directories.trials())

    return router
