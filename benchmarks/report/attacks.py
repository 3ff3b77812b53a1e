"""Blocks of ``docs/results/cluster.md`` about strikes, in Markdown, from recorded files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from benchmarks.report.cluster import verdict
from benchmarks.report.markdown import measured_on, table

Result = Mapping[str, Any]
MAX_CHANGES = 12
"""Changes of the status that are named one by one."""


def strikes_table(result: Result) -> str:
    """Every strike: what was asked, what was seen, and what the status said meanwhile."""
    rows = [
        (each["name"].replace("-", " "), each["must"], each["measured"], _conditions(each), verdict(each["reached"]))
        for each in result["strikes"]
    ]
    return table(("strike", "must", "measured", "condition in the status", ""), rows)


def strikes_words(result: Result) -> str:
    """Sum of all strikes."""
    judged = [each for each in result["strikes"] if each["reached"] is not None]
    reached = sum(each["reached"] for each in judged)
    tracebacks = sum(each["tracebacks"] for each in judged)
    commits = Counter(f"at `{each['commit'][:7]}`" if each.get("commit") else "without a commit" for each in judged)
    recorded = ", ".join(f"{num} {where}" for where, num in commits.items())
    return (
        f"{reached} of {len(judged)} strikes ended as they must; {tracebacks} tracebacks in all logs. Rows were "
        f"recorded one by one: {recorded}. The newest was recorded here:{measured_on(result['machine'])}"
    )


def _conditions(strike: Result) -> str:
    if not strike["conditions"]:
        return ""
    if len(strike["conditions"]) > MAX_CHANGES:
        times = Counter(condition for _, _, condition in strike["conditions"])
        return ", ".join(f"{condition} {num} times" for condition, num in times.items())
    changes = [
        f"{condition if state in ('starting', 'running') else state} from {seconds:.0f} s"
        for seconds, state, condition in strike["conditions"]
    ]
    return ", ".join(changes) if len(changes) > 1 else changes[0].partition(" ")[0]
