"""The version of this package, which ``tests/test_project.py`` compares with the project file; its commit."""

from __future__ import annotations

import functools
from pathlib import Path

__version__ = "0.3.0"
LEARNING_VERSION = 2
"""Raised by hand when the same configuration learns something else: by another world, learner or game, not by another
rounding. Results of two of these numbers are not put into one table. 1: until decision 44; results then had no number.
"""


@functools.cache
def git_commit() -> str | None:
    """The commit of this program's own checkout, with ``-dirty`` for local changes; None outside of one."""
    root = Path(__file__).resolve().parents[2]
    top = _git(root, "rev-parse", "--show-toplevel")
    # an installation inside another repository must not claim that repository's commit
    if top is None or Path(top).resolve() != root:
        return None
    return _git(root, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")


def _git(root: Path, *arguments: str) -> str | None:
    import subprocess  # here: importing the package stays cheap

    command = ["git", "-C", str(root), *arguments]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip() or None
