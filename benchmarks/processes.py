"""The processes of a run, from /proc: their roles and their CPU time. Linux only."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

PROC = Path("/proc")
_ROLES = (
    ("ray::RolloutActor", "actor"),
    ("ray::LearnerActor", "learner"),
    ("ray::GeneratorActor", "generator"),
    ("ray::StatusWorker", "status"),
    ("ray::IDLE", "idle worker"),
    ("ray::", "other worker"),
    ("raylet/raylet", "raylet"),
    ("gcs/gcs_server", "gcs"),
    ("redis-server", "redis"),
    ("runtime_env/agent", "runtime env agent"),
    ("dashboard/agent", "dashboard agent"),
    ("dashboard/dashboard", "dashboard"),
    ("log_monitor", "log monitor"),
    ("autoscaler", "autoscaler"),
)
"""Part of a command line and the role it shows; the first match counts."""
_TICKS = os.sysconf("SC_CLK_TCK")


def role(command_line: str) -> str:
    """Role of a process of a run by its command line; ``other`` for what is none of ours."""
    return next((name for part, name in _ROLES if part in command_line), "other")


def descendants(root: int) -> dict[int, str]:
    """Roles by pid of ``root``, the ``driver``, and of all living processes below it."""
    children: dict[int, list[int]] = {}
    for pid, parent_pid in _parents():
        children.setdefault(parent_pid, []).append(pid)
    found, line = {root: "driver"}, [root]
    while line:
        for pid in children.get(line.pop(), ()):
            found[pid] = role(_command_line(pid))
            line.append(pid)
    return found


def cpu_s(pid: int) -> float:
    """CPU seconds of a process and its dead children; 0 if it has ended."""
    fields = _stat(pid)
    return sum(map(int, fields[11:15])) / _TICKS if fields else 0.0


def cpu_s_by_role(root: int) -> dict[str, float]:
    """CPU seconds of ``root`` and all below it, summed by role."""
    seconds = defaultdict[str, float](float)
    for pid, name in descendants(root).items():
        seconds[name] += cpu_s(pid)
    return dict(seconds)


def is_running(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    fields = _stat(pid)
    return bool(fields) and fields[0] != "Z"


def _parents() -> Iterator[tuple[int, int]]:
    for path in PROC.iterdir():
        if path.name.isdecimal() and (fields := _stat(int(path.name))) and fields[0] != "Z":
            yield int(path.name), int(fields[1])


def _stat(pid: int) -> list[str]:
    """Fields from the third one on, the state; the second, the program's name, may have spaces in it."""
    try:
        return (PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def _command_line(pid: int) -> str:
    try:
        return (PROC / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return ""
