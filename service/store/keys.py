"""The keys that tandem uses in Redis; nothing else in there is touched.

| key | type | content |
|---|---|---|
| ``tandem:runs`` | sorted set | run ids by when they were last started, in seconds since 1970 |
| ``tandem:run:ID:status`` | string | ``RunStatus`` as JSON |
| ``tandem:run:ID:metrics`` | sorted set | records as JSON by iteration, the newest ``MAX_RECORDS`` |
| ``tandem:run:ID:goals`` | string | ``GoalGrid`` as JSON |
| ``tandem:run:ID:stop`` | string | is there when somebody asked the run to stop |
| ``tandem:run:ID:lease`` | string, expires | who runs it, as JSON; gone ``LEASE_S`` after its last sign of life |
| ``tandem:run:ID:epoch`` | string | how many drivers have claimed it: only the last of them writes anything |

Records are in a sorted set and no stream: written twice, as after an answer that got lost, a record is there once, and
a resumed run's takes the place of the earlier one.
"""

from __future__ import annotations

from typing import Literal

RUNS = "tandem:runs"
MAX_RECORDS = 20_000
"""Of one run, about 60 MB; ``metrics.jsonl`` has them all."""
LEASE_S = 10.0


def run_key(run_id: str, content: Literal["status", "metrics", "goals", "stop", "lease", "epoch"]) -> str:
    """Key of one value of a run."""
    return f"tandem:run:{run_id}:{content}"
