"""The blocks of ``docs/results/robust.md``, in Markdown, from the recorded files."""

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


def ranges_table(result: Result) -> str:
    """What students of worlds with one range have in the nominal world and in theirs, beside their teacher."""
    head = ("drawn", "range", "student, nominal world", "student, worlds that draw it", "teacher there")
    rows = []
    for name, row in result["rows"].items():
        drawn = [value for key, value in row["ranges"].items() if key != "num_models"]
        span = f"{drawn[0][0]:g} to {drawn[0][1]:g}" if len(drawn) == 1 else ""
        shares = (row[each]["success_last"] for each in ("student_nominal", "student_drawn", "teacher_drawn"))
        rows.append((name.replace("_", " "), span, *(percent(share, 1) for share in shares)))
    return table(head, rows)


def ranges_words(result: Result) -> str:
    """How the students learned, and where it was measured."""
    settings = result["settings"]
    steps = f"{settings['env_steps'] / 1e6:g} M env steps"
    teacher = percent(next(iter(result["rows"].values()))["teacher_nominal"]["success_last"], 1)
    return (
        f"Success at the last step of {settings['episodes']} mixed goals. Each student learned for {steps}, one seed, "
        f"from `{settings['teacher']}`, who has {teacher} in the nominal world.{measured_on(result['machine'])}"
    )
