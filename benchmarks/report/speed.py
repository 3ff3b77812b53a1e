"""The block of ``docs/results/README.md`` about speed: ratios of what was measured in turn, in Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.report.markdown import measured_on, table

Result = Mapping[str, Any]


def ratios_block(results: Sequence[Result]) -> str:
    """A row for each ratio of two rates, and where they were measured."""
    rows = [
        (name, f"{each['median']:.2f}", f"{each['least']:.2f} to {each['greatest']:.2f}", f"{each['cpu']:.2f}")
        for result in results
        for name, each in result["ratios"].items()
    ]
    where = "".join(f"`{result['benchmark']}`:{measured_on(result['machine'])} " for result in results).rstrip()
    return f"{table(('env steps/s', 'median', 'all turns', 'by CPU time'), rows)}\n\n{where}"
