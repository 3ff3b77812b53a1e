"""A run of a study as a Ray task: a training on one machine of the cluster, in a process below the task's."""

from __future__ import annotations

import time
from contextlib import closing
from typing import Any

import ray
from ray.exceptions import RayError, TaskCancelledError

from service.base.errors import one_line
from service.cluster.self_play import num_gpus
from service.runs.study import POLL_S, Job, Place, RunProcess
from service.runs.study_file import StudyRun

MAX_RETRIES = 3
"""Times that a task is tried again whose machine was lost; it goes on where the new one sees the same directory."""


class RayTask:
    """The task of a run. It waits for cores of its own where there are none yet."""

    def __init__(self, job: Job) -> None:
        self._job = job
        task = ray.remote(num_cpus=job.num_cores, num_gpus=num_gpus(job.device), max_retries=MAX_RETRIES)(run_here)
        self._reference: Any = task.remote(job)

    def poll(self) -> StudyRun | None:
        """How the run was left; None while it goes on."""
        if not ray.wait([self._reference], timeout=0.0)[0]:
            return None
        try:
            found: StudyRun = ray.get(self._reference)
        except TaskCancelledError:  # before it began
            return self._job.run
        except RayError as error:
            text = f"its task failed: {one_line(str(error).strip(), 300)}"
            return self._job.run.model_copy(update={"state": "failed", "error": text})
        return found

    def stop(self) -> None:
        """Ask it to end after its iteration, saved."""
        ray.cancel(self._reference, force=False)

    def close(self) -> None:
        """End it at once, if it goes on."""
        ray.cancel(self._reference, force=True)


def run_here(job: Job) -> StudyRun:
    """Train on this machine until the run ends, or until the task is cancelled and the run has saved."""
    is_canceled = ray.get_runtime_context().is_canceled
    with closing(RunProcess(job)) as process:
        while True:
            try:
                while (found := process.poll()) is None:
                    if is_canceled():
                        process.stop()
                    time.sleep(POLL_S)
                return found
            except KeyboardInterrupt:  # how Ray says so at once, where no import swallows it
                process.stop()


def cluster_place() -> Place:
    """The cluster that this process is connected to, with the nodes that are there now."""
    cores = [int(node["Resources"].get("CPU", 0.0)) for node in ray.nodes() if node["Alive"]]
    return Place(max(1, sum(cores)), max(1, *cores), RayTask)
