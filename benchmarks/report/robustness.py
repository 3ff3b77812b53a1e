"""The block of ``docs/results/robust.md``, in Markdown, from the recorded file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.report.markdown import measured_on, percent, table

Result = Mapping[str, Any]


def robustness_table(result: Result) -> str:
    """Success of each policy at the last step, and ever, in each world."""
    policies = result["settings"]["policies"].split(",")
    head = ("world", *(f"`{policy}`: last, ever" for policy in policies))
    rows = []
    for name, row in result["rows"].items():
        cells = (
            f"{percent(row[each]['success_last'], 1)}, {percent(row[each]['success_ever'], 1)}" for each in policies
        )
        rows.append((name, *cells))
    return table(head, rows)


def robustness_words(result: Result) -> str:
    """How many goals, what drawing costs, and where it was measured."""
    cost = result["cost"]
    return (
        f"{result['settings']['episodes']} mixed goals each, 50 steps. Worlds that draw everything make "
        f"{cost['cpu']:.2f} times as many env steps per CPU second as the nominal one, with random arms."
        f"{measured_on(result['machine'])}"
    )
