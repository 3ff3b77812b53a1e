"""A run of a study as a Ray task: a training on one machine of the cluster, in a process below the task's."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import ray
from ray.exceptions import RayError, TaskCancelledError

from service.base.errors import one_line
from service.cluster.ray_connection import num_gpus
from service.runs.study_run import END_NOW, GO_ON, POLL_S, STOP, Asked, Job, Place, StudyRun, run_process

ENVIRONMENT = {"env_vars": {"RAY_kill_child_processes_on_worker_exit": "0"}}
"""Of a task: when its driver dies Ray would kill the training, which notices that itself and saves."""
MAX_RETRIES = 3
"""Times that a task is tried again whose machine was lost; it goes on where the new one sees the same directory."""


def run_as_task(job: Job, asked: Asked) -> StudyRun:
    """Run a job in a task, which waits for cores of its own where there are none yet.

    Returns:
        How the run was left.
    """
    needs = ray.remote(
        num_cpus=job.num_cores, num_gpus=num_gpus(job.device), max_retries=MAX_RETRIES, runtime_env=ENVIRONMENT
    )
    reference: Any = needs(run_here).remote(job)
    told = GO_ON
    while not ray.wait([reference], timeout=POLL_S)[0]:
        if (now := asked()) > told:
            told = now
            ray.cancel(reference, force=told == END_NOW)
        if told == END_NOW:
            return job.run
    try:
        found: StudyRun = ray.get(reference)
    except TaskCancelledError:  # before it began
        return job.run
    except RayError as error:
        return job.run.now("failed", f"its task failed: {one_line(str(error).strip(), 300)}")
    return found


def run_here(job: Job) -> StudyRun:
    """Train on this machine until the run ends, or until the task is cancelled and the run has saved."""
    # Ray's own are the cores of the task: threads of NumPy's and torch's would fight with those that step the worlds.
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    is_canceled, asked = ray.get_runtime_context().is_canceled, GO_ON
    with ThreadPoolExecutor(1) as threads:
        process = threads.submit(run_process, job, lambda: asked)
        while True:
            try:
                asked = STOP if is_canceled() else asked
                return process.result(POLL_S)
            except TimeoutError:
                pass
            except KeyboardInterrupt:  # how Ray says so at once, where no import swallows it
                asked = STOP


def cluster_place() -> Place:
    """The cluster that this process is connected to, with the nodes that are there now."""
    cores = [int(node["Resources"].get("CPU", 0.0)) for node in ray.nodes() if node["Alive"]]
    return Place(max(1, sum(cores)), max(1, *cores), run_as_task)
