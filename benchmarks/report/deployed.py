"""The block of ``docs/results/deployed.md``, in Markdown, from the recorded file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.report.markdown import measured_on, table

Result = Mapping[str, Any]


def deployed_blocks(found: Mapping[str, Result]) -> dict[str, list[str]]:
    """Parts of the block about the deployment, if it was recorded."""
    result = found.get("deployed")
    return {"checks": [checks_words(result), checks_table(result)]} if result is not None else {}


def checks_words(result: Result) -> str:
    """How many checks passed, and what was built."""
    passed = sum(each["outcome"] == "passed" for each in result["checks"])
    return (
        f"{passed} of {len(result['checks'])} checks passed. The image has {result['image']['size']}."
        f"{measured_on(result['recorded'])}"
    )


def checks_table(result: Result) -> str:
    """Every check in its order: what must be so, and what was seen."""
    rows = [
        (
            each["what"],
            _cell(each["seen"]),
            f"{each['seconds']:.0f} s",
            "" if each["outcome"] == "passed" else "**failed**",
        )
        for each in result["checks"]
    ]
    return table(("what must be so", "what was seen", "took", ""), rows)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
