"""Blocks of ``docs/results/cluster.md`` about strikes and floods, in Markdown, from recorded files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.report.cluster import verdict
from benchmarks.report.markdown import measured_on, table

Result = Mapping[str, Any]

MAX_GROWTH_MB = 20.0
"""Memory is flat if it grows by less: the buffers of as many connections as may be open hold no more."""
MAX_LIVEZ_MS = 100.0
_FLOODS = {
    "half_open": "{num_opened:,} connections that never finish a request",
    "endless_headers": "{megabytes:.0f} MB of headers over {num_opened:,} connections",
}


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


def flood_table(result: Result) -> str:
    """What was sent, what the service's memory was, and how long ``livez`` took."""
    rows = []
    for kind, words in _FLOODS.items():
        each = result[kind]
        memory, livez = each["memory_mb"], each["livez"]
        grown = memory["most"] - memory["before"]
        well = grown < MAX_GROWTH_MB and livez["max_ms"] < MAX_LIVEZ_MS and not each["num_failed"]
        sent = words.format(num_opened=each["num_opened"], megabytes=each.get("num_bytes", 0) / 1e6)
        took = f"{livez['p50_ms']:.1f} ms, at most {livez['max_ms']:.0f} ms of {livez['num']:,}"
        rows.append((sent, f"{memory['before']:.1f} MB, {grown:+.1f} MB", took, str(each["num_failed"]), verdict(well)))
    asked = f"memory grows by less than {MAX_GROWTH_MB:g} MB, livez < {MAX_LIVEZ_MS:g} ms"
    return table((f"flood ({asked})", "memory", "livez", "failed", ""), rows)


def flood_words(result: Result) -> str:
    """Machine and day."""
    return (
        "The flood comes from a process of the same machine that gives way to the service (`nice`)."
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
