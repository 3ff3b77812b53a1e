"""The processes of a run, from /proc: which one is which, the memory and the CPU time they take. Linux only."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")
_TITLES = (
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
"""What a command line contains, first match counts, and what the process is called here."""
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Memory:
    """Of one process, in MB."""

    pss: float
    """Its own memory and its share of what it shares with others."""
    shared_pss: float
    """Of it, in shared memory: rollouts and weights in Ray's object store."""
    own: float
    """What a leak would add to: neither shared memory nor files, also where it was swapped out. What a process pays of
    a library depends on who else uses it, so that all others seem to shrink when a program starts."""


def role(command_line: str) -> str:
    """What a process of a run is, from its command line; ``other`` for what is none of ours."""
    return next((name for part, name in _TITLES if part in command_line), "other")


def descendants(root: int) -> dict[int, str]:
    """Roles of all living processes that ``root`` started, and they in turn, by pid; ``root`` is the ``driver``."""
    children: dict[int, list[int]] = {}
    for pid, parent in _parents():
        children.setdefault(parent, []).append(pid)
    found, line = {root: "driver"}, [root]
    while line:
        for pid in children.get(line.pop(), ()):
            found[pid] = role(_command_line(pid))
            line.append(pid)
    return found


def named(processes: Mapping[int, str]) -> dict[int, str]:
    """``processes`` with a number, in the order of their pids, where several have one role: actor-0, actor-1, ..."""
    count, seen = Counter(processes.values()), Counter[str]()
    names = {}
    for pid, name in sorted(processes.items()):
        names[pid] = f"{name}-{seen[name]}" if count[name] > 1 else name
        seen[name] += 1
    return names


def memory(pid: int) -> Memory | None:
    """Of a process; None if it has ended."""
    try:
        lines = (PROC / str(pid) / "smaps_rollup").read_text().splitlines()[1:]
    except OSError:
        return None
    kilobytes = {name: int(rest.split()[0]) for name, _, rest in (line.partition(":") for line in lines)}
    if not kilobytes:  # ending just now
        return None
    pss, shared, own, swapped = (kilobytes.get(name, 0) / 1024 for name in ("Pss", "Pss_Shmem", "Pss_Anon", "SwapPss"))
    return Memory(pss, shared, own + swapped)


def cpu_s(pid: int) -> float:
    """CPU seconds a process has taken, its dead children's included; 0 if it has ended."""
    fields = _stat(pid)
    return sum(map(int, fields[11:15])) / _TICKS if fields else 0.0


def parent(pid: int) -> int | None:
    """Who started a process; None if it has ended."""
    fields = _stat(pid)
    return int(fields[1]) if fields else None


def is_running(pid: int) -> bool:
    """Whether a process is there and no zombie."""
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
