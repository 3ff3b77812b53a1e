"""Runs to tell about, and how to wait for what another thread or process does."""

import time
from datetime import UTC, datetime, timedelta

from service.store.models import GoalCell, GoalGrid, RunStatus
from service.store.redis_writer import RedisWriter


def a_status(run_id="cube", **changes):
    now = datetime.now(UTC)
    fields = {"run_id": run_id, "name": "panda-cube", "runtime": "local", "state": "running"}
    return RunStatus(**(fields | {"started": now, "heartbeat": now, "total_env_steps": 1000} | changes))


def a_silent_status(**changes):
    return a_status(heartbeat=datetime.now(UTC) - timedelta(seconds=61), **changes)


def a_writer(address, run_id="cube", *, run="a", epoch=1, resumed=False):
    """A process that reports to Redis."""
    return RedisWriter(address, run_id, run=run, epoch=epoch, resumed=resumed)


def a_grid(iteration=1):
    cell = GoalCell(center_m=(0.4, 0.0, 0.1), num_tries=3, success_rate=0.5, learnability=0.25)
    return GoalGrid(
        iteration=iteration,
        num_env_steps=100 * iteration,
        cell_size_m=0.05,
        shape=(2, 2, 1),
        num_cells=4,
        lower_m=(0.0, 0.0, 0.0),
        upper_m=(0.1, 0.1, 0.05),
        cells=(cell,),
    )


def a_record(iteration, **more):
    return {"iteration": iteration, "env_steps": 100 * iteration, "bob/success_rate": iteration / 7} | more


def wait_until(holds, *, within_s=300.0):
    """Return once ``holds()`` is true; what it last said when it never is."""
    deadline_s, pause_s = time.monotonic() + within_s, 0.01
    while not (said := holds()):
        assert time.monotonic() < deadline_s, f"still {said!r} after {within_s} s"
        time.sleep(pause_s)
        pause_s = min(0.1, 1.5 * pause_s)  # what is waited for needs the core
    return said
