"""A count of the work that this process has done, raised by the loops that work, and read by a thread beside them.

A thread that merely answers proves nothing about the one that works; a count that grows does.
"""

from __future__ import annotations

_count = 0


def count_work() -> None:
    """Count a piece of work, such as a step of all worlds or a gradient step: a fraction of a second of it."""
    global _count
    _count += 1


def work_done() -> int:
    """Pieces of work so far."""
    return _count
