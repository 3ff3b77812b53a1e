"""Environment variables of a Ray worker; import it before NumPy, torch and MuJoCo, which read them at their import.

A runtime environment of the actor would set them, too, but Ray then starts every worker by way of another Python that
imports all of Ray: 0.4 s of a core for each.
"""

from __future__ import annotations

import os

import ray

WORKER_VARIABLES = {
    # NumPy's own threads would fight with those that step the worlds and with the other actors.
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    # Nothing is drawn there, and MuJoCo would look for a window library, with a process of its own.
    "MUJOCO_GL": "disable",
}

if ray.is_initialized() and ray.get_runtime_context().worker.mode == ray.WORKER_MODE:
    os.environ |= WORKER_VARIABLES
