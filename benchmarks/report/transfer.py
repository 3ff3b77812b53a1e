"""The blocks of ``docs/results/transfer.md``, in Markdown, from the recorded files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.report.markdown import measured_on, percent, table
from benchmarks.transfer import ACCELERATION_M_S2, LIMITED, LIMITED_SUCCESS, ROWS, SPEED_M_S

Result = Mapping[str, Any]


def transfer_table(result: Result) -> str:
    """Success of every row that was measured, beside what was asked."""
    rows = []
    for name, row in ROWS.items():
        if name not in result["rows"]:
            rows.append((row.title, "", "", "", percent(row.asked), "not measured"))
            continue
        each = result["rows"][name]
        last = f"{percent(each['success_last'], 1)} {_interval(each, 'last')}"
        reached = "yes" if each["success_last"] >= row.asked else "no"
        covered = ", ".join(percent(share) for share in each["calibration"]["covered_share"])
        rows.append((row.title, last, percent(each["success_ever"], 1), covered, percent(row.asked), reached))
    head = ("", "success at the last step", "ever", "covered a step, x, y, z", "asked", "reached")
    return table(head, rows)


def transfer_words(result: Result) -> str:
    """What was played, the motion of the tip, the stops, and where it was measured."""
    rows, settings = result["rows"], result["settings"]
    num_goals = sorted({row["num_goals"] for row in rows.values()})
    words = [
        f"{result['policy']['label']}, {', '.join(map(str, num_goals))} goals a row, {settings['num_steps']} steps; "
        "95 % Wilson intervals. In the nominal world of training and without the bridge it reaches "
        f"{percent(result['nominal_world']['success_last'], 1)} of such goals."
    ]
    if LIMITED in rows:
        each = rows[LIMITED]
        words.append(
            f"In the first row the set-points stay inside {SPEED_M_S:g} m/s and {ACCELERATION_M_S2:g} m/s2 in "
            f"{percent(each['set_point_inside'], 1)} of steps and the tip itself in {percent(each['tip_inside'], 1)}: "
            f"in {percent(each['free_tip_inside'], 2)} of those in which the arm touches nothing "
            f"({percent(each['free'])} of all). Asked were 100 %, and {percent(LIMITED_SUCCESS)} success."
        )
    stops = sum(row["num_stops"] for row in rows.values())
    words.append(f"The bridge's safety stopped {stops} of {sum(row['num_goals'] for row in rows.values())} goals.")
    bridge = settings["set_points_per_step"], settings["max_speed_m_s"], settings["max_acceleration_m_s2"]
    words.append(
        "The bridge of all rows: {} set-points a step, at most {:g} m/s and {:g} m/s2, ".format(*bridge)
        + f"a grip of at most {settings['grip_force_n']:g} N.{measured_on(result['machine'])}"
    )
    return " ".join(words)


def _interval(each: Result, name: str) -> str:
    return f"({percent(each[f'success_{name}_low'])} to {percent(each[f'success_{name}_high'])})"
