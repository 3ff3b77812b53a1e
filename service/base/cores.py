"""Cores of this machine."""

from __future__ import annotations

import os


def usable_cores() -> int:
    """Cores that this process may use."""
    # macOS does not say, and has no such function
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
