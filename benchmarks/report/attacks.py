"""Blocks of ``docs/results/cluster.md`` about strikes, in Markdown, from recorded files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.report.cluster import verdict
from benchmarks.report.markdown import measured_on, table

Result = Mapping[str, Any]


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
    return (
        f"{reached} of {len(judged)} strikes ended as they must; {tracebacks} tracebacks in all logs."
        f"{measured_on(result['machine'])}"
    )


def _conditions(strike: Result) -> str:
    if not strike["conditions"]:
        return ""
    changes = [
        f"{condition if state in ('starting', 'running') else state} from {seconds:.0f} s"
        for seconds, state, condition in strike["conditions"]
    ]
    return ", ".join(changes) if len(changes) > 1 else changes[0].partition(" ")[0]
