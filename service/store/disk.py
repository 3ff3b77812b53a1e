"""Live reports as files in the run directory: for ``tandem serve --runs`` and for everyone with a text editor.

| file | content |
|---|---|
| ``status.json`` | ``RunStatus``, at every change of state or condition and else about once a second |
| ``goals.json`` | ``GoalGrid``, about every five seconds |
| ``stop`` | is there when the run was asked to stop |

Metrics are in ``metrics.jsonl``, where the run writes them for itself.
"""

from __future__ import annotations

from pathlib import Path

from service.base.parsing import ParseError, parse_with
from service.base.regular_files import read_regular
from service.store.models import RunStatus

MAX_BYTES = 64 * 1024 * 1024
"""Greatest size of a run's status, and of its grid of goals."""
STATUS_FILE = "status.json"
GOALS_FILE = "goals.json"
STOP_FILE = "stop"
STUDY_FILE = "study.json"
"""In the directory of a study, which has a run directory for each of its runs."""
OUTPUT_FILE = "log.txt"
"""All that the processes of a study's run said."""


def read_status(directory: Path) -> RunStatus | None:
    """The status that the last process of a run left in its directory; None where there is none that can be read."""
    try:
        data = read_regular(directory / STATUS_FILE, MAX_BYTES)
        return parse_with(RunStatus.model_validate_json, data, STATUS_FILE)
    except (OSError, ParseError):
        return None
