"""The block of ``docs/api.md`` about the speed of the page, in Markdown, from the recorded file."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

from benchmarks.report.markdown import measured_on, table

Result = Mapping[str, Any]
TARGETS_S = {"first view": 1.0, "comparing": 2.0}
MAX_GROWTH = 1.1
"""Memory after the last round may be so many times that after the first one, which fills what is kept."""


def page_table(result: Result) -> str:
    """Time and CPU time until each view is painted, and memory, beside what was asked for."""
    settings = result["settings"]
    words = {"first view": f"all {settings['runs']} runs", "comparing": f"{settings['compared']} runs compared"}
    busy = result["machine"]["load_average"][0] > result["machine"]["num_cpus"] / 2
    rows = []
    for view, target_s in TARGETS_S.items():
        each = result["views"][view]
        middle = statistics.median(each["painted_s"])
        spread = f"{middle:.2f} s ({min(each['painted_s']):.2f} to {max(each['painted_s']):.2f})"
        cpu = [f"{statistics.median(each[key]):.2f} s" for key in ("browser_cpu_s", "service_cpu_s")]
        verdict = "not judged: other programs were busy" if busy and middle >= target_s else _verdict(middle < target_s)
        rows.append((words[view], f"< {target_s:g} s", spread, *cpu, verdict))
    _, first, *_, last = result["memory"]
    flat = last / first < MAX_GROWTH
    grown = f"{first / 1e6:.0f} MB, then {last / 1e6:.0f} MB"
    rows.append(
        (
            "memory of the service, all curves of all runs asked for again and again",
            "flat",
            grown,
            "",
            "",
            _verdict(flat),
        )
    )
    return table(("", "asked", "measured", "CPU time, browser", "CPU time, service", ""), rows)


def page_words(result: Result) -> str:
    """What was measured, and where."""
    settings, load = result["settings"], result["machine"]["load_average"][0]
    size = f"{settings['runs']} runs of {settings['records']:,} records each, {result['num_bytes'] / 1e9:.1f} GB"
    return (
        f"{size}, most of them in the memory of the kernel. A service and a Chromium that have just started, from the "
        "moment at which the browser is sent to the address until the last curve is painted; median of "
        f"{settings['repeats']}. The CPU time of the browser is that of its main thread. The machine had a load of "
        f"{load:g}.{measured_on(result['machine'])}"
    )


def _verdict(reached: bool) -> str:
    return "reached" if reached else "**missed**"
