"""The processes of a run, from /proc: their roles, their memory and their CPU time. Linux only."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

PROC = Path("/proc")
_ROLES = (
    ("ray::RolloutWorker", "actor"),
    ("ray::LearnerWorker", "learner"),
    ("ray::GeneratorWorker", "generator"),
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


def named(processes: Mapping[int, str]) -> dict[int, str]:
    """Names by pid: the role, with a number in the order of pids where several share it (actor-0, actor-1, ...)."""
    count, seen = Counter(processes.values()), Counter[str]()
    names = {}
    for pid, name in sorted(processes.items()):
        names[pid] = f"{name}-{seen[name]}" if count[name] > 1 else name
        seen[name] += 1
    return names


def own_memory_mb(pid: int) -> float | None:
    """Anonymous memory of a process in MB, swapped or not; None if it has ended.

    It is what a leak adds to. Files and shared memory are left out: what a process pays of a library depends on who
    else uses it, so that all others seem to shrink when a program starts.
    """
    try:
        lines = (PROC / str(pid) / "smaps_rollup").read_text().splitlines()[1:]
    except OSError:
        return None
    kilobytes = {name: int(rest.split()[0]) for name, _, rest in (line.partition(":") for line in lines)}
    if not kilobytes:  # ending just now
        return None
    return (kilobytes.get("Pss_Anon", 0) + kilobytes.get("SwapPss", 0)) / 1024


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


def parent(pid: int) -> int | None:
    """Pid of the process that started ``pid``; None if that has ended."""
    fields = _stat(pid)
    return int(fields[1]) if fields else None


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
