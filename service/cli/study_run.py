"""The process of one run of a study: ``tandem``, which is told to stop when the study's process is gone."""

from __future__ import annotations

import ctypes
import os
import sys

from service.cli.main import main

PR_SET_PDEATHSIG = 1
"""From linux/prctl.h."""


def stop_with(parent: int) -> None:
    """Let the kernel send ``PASSED_ON`` when the parent process ends; else a run would go on alone.

    Only Linux can do that.

    Args:
        parent: id of the process that started this one.
    """
    from service.runs.signals import PASSED_ON

    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, int(PASSED_ON))
    if os.getppid() != parent:  # it ended a moment ago, and no signal comes
        sys.exit(128 + PASSED_ON)


if __name__ == "__main__":
    stop_with(int(sys.argv.pop(1)))
    main()
