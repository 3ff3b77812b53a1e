"""The keys that tandem uses in Redis; nothing else in there is touched.

| key | type | content |
|---|---|---|
| ``tandem:runs`` | sorted set | run ids by when they were last started, in seconds since 1970 |
| ``tandem:run:ID:status`` | string | ``RunStatus`` as JSON |
| ``tandem:run:ID:metrics`` | sorted set | records as JSON by iteration, the newest ``MAX_RECORDS`` |
| ``tandem:run:ID:goals`` | string | ``GoalGrid`` as JSON |
| ``tandem:run:ID:stop`` | string | is there when the run was asked to stop |
| ``tandem:run:ID:heartbeat`` | string, expires | is there until ``HEARTBEAT_S`` after its process last reported |
| ``tandem:run:ID:epoch`` | string | ``RUN:EPOCH``: identity of the run and number of the process that reports |

Records are in a sorted set and no stream: written twice, as after an answer that got lost, a record is there once, and
a resumed run's takes the place of the earlier one.
"""

from __future__ import annotations

from typing import Literal

RUNS = "tandem:runs"
MAX_RECORDS = 20_000
"""Of one run, about 60 MB; ``metrics.jsonl`` has them all."""
HEARTBEAT_S = 10.0


def run_key(run_id: str, content: Literal["status", "metrics", "goals", "stop", "heartbeat", "epoch"]) -> str:
    """Key of one value of a run."""
    return f"tandem:run:{run_id}:{content}"
