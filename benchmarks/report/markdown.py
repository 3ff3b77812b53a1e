"""Words that all pages share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Row = Sequence[str]


def percent(share: float, digits: int = 0) -> str:
    """A share for a cell or a sentence; nothing for not-a-number."""
    return f"{100 * share:.{digits}f} %" if np.isfinite(share) else ""


def millions(env_steps: float) -> str:
    """Env steps for a cell."""
    return f"{env_steps / 1e6:.3g} M"


def from_to(numbers: Sequence[int]) -> str:
    """The least and the greatest of some numbers, as ``1 to 3``; a single one where all are equal."""
    return " to ".join(map(str, dict.fromkeys((min(numbers), max(numbers)))))


def duration(seconds: float) -> str:
    """Minutes, or hours from two on."""
    return f"{seconds / 3600:.1f} h" if seconds >= 7200 else f"{seconds / 60:.0f} min"


def commit(name: str) -> str:
    """A commit for a sentence, cut to 7 characters; local changes are told beside it."""
    short = f"commit `{name[:7]}`"
    return f"{short} with local changes" if name.endswith("-dirty") else short


def measured_on(machine: Mapping[str, Any]) -> str:
    """The last sentence of a block: machine, commit and day of a measurement, and how busy the machine was before."""
    busy = ""
    if load := machine.get("load_average"):
        busy = f"; load when it began {load[0]:.1f}, over the 15 minutes before {load[2]:.1f}"
    where = f"{machine['num_cpus']} cores of {machine['cpu']}, {commit(machine['git_commit'])}"
    return f" On {where}, {machine['time'][:10]}{busy}."
