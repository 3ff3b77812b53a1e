"""The processes of a run: their roles and their CPU time."""

from __future__ import annotations

from collections import defaultdict
from contextlib import suppress

import psutil

_ROLES = (
    ("ray::RolloutActor", "actor"),
    ("ray::LearnerActor", "learner"),
    ("ray::GeneratorActor", "generator"),
    ("ray::StatusWorker", "status"),
    ("raylet/raylet", "raylet"),
)
"""Part of a command line and the role it shows."""


def role(command_line: str) -> str:
    """Role of a process of a run by its command line; ``other`` for what is none of these."""
    return next((name for part, name in _ROLES if part in command_line), "other")


def descendants(root: int) -> dict[int, str]:
    """Roles by pid of ``root``, the ``driver``, and of all living processes below it."""
    found = {root: "driver"}
    with suppress(psutil.NoSuchProcess):
        for process in psutil.Process(root).children(recursive=True):
            with suppress(psutil.NoSuchProcess):
                if process.status() != psutil.STATUS_ZOMBIE:
                    found[process.pid] = role(" ".join(process.cmdline()))
    return found


def cpu_s_by_role(root: int) -> dict[str, float]:
    """CPU seconds of ``root`` and all below it, with those of their dead children, summed by role."""
    seconds = defaultdict[str, float](float)
    for pid, name in descendants(root).items():
        with suppress(psutil.NoSuchProcess):
            seconds[name] += sum(psutil.Process(pid).cpu_times()[:4])
    return dict(seconds)
