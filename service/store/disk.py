"""Live reports as files in the run directory: for ``tandem serve --runs`` and for everyone with a text editor.

| file | content |
|---|---|
| ``status.json`` | ``RunStatus``, at every change of state or condition and else about once a second |
| ``goals.json`` | ``GoalGrid``, about every five seconds |
| ``stop`` | is there when somebody asked the run to stop |

Metrics are in ``metrics.jsonl``, where the run writes them for itself.
"""

from __future__ import annotations

from pathlib import Path

from service.parsing import ParseError, parse_json, parse_with
from service.regular_files import read_regular
from service.store.models import RunStatus

MAX_BYTES = 64 * 1024 * 1024
"""Of a run's status, its grid of goals and its note of what it published."""
STATUS_FILE = "status.json"
GOALS_FILE = "goals.json"
STOP_FILE = "stop"


def read_status(directory: Path) -> RunStatus | None:
    """The status that the last process of a run left in its directory; None where there is none that can be read."""
    try:
        data = read_regular(directory / STATUS_FILE, MAX_BYTES)
        return parse_with(RunStatus.model_validate_json, data, STATUS_FILE)
    except (OSError, ParseError):
        return None


def read_published(directory: Path) -> str | None:
    """``NAME@VERSION`` of what a run published last; None where there is none, or where that cannot be read."""
    try:
        return str(parse_json(read_regular(directory / "published.json", MAX_BYTES), directory)["version"])
    except (OSError, KeyError, TypeError, ValueError):
        return None
