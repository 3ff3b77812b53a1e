"""Tables of ``docs/results/skills.md``, in Markdown: where random skills take the object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from benchmarks.report.markdown import Row, millions, percent
from benchmarks.run_files import RANDOM, STAGES, Run, mean_share
from service.base.markdown import table

METHODS = {"ours": "ours", "metra": "METRA", "lsd": "LSD", "dads": "DADS", "diayn": "DIAYN"}
"""Names in tables and pictures by recorded method, in the order of rows."""


def by_method(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs of each method in the order of their seeds, methods in the order of ``METHODS``."""
    order = list(METHODS)
    found = sorted(runs, key=lambda run: (order.index(run["method"]), run["config"]["seed"]))
    return {method: list(group) for method, group in groupby(found, key=lambda run: str(run["method"]))}


def coverage_table(runs: Sequence[Run]) -> str:
    """Share of the table's cells that random skills visit at each stage: mean of the seeds, and in brackets each."""
    random = [mean_share(run["coverage"]["stages"][RANDOM]) for run in runs]
    rows: list[Row] = [(RANDOM, "", "", "", "", percent(float(np.mean(random))))]
    for method, seeds in by_method(runs).items():
        steps = np.mean([run["series"]["env_steps"][-1] for run in seeds])
        shares = {
            stage: [
                mean_share(found[stage]) for found in (run["coverage"]["stages"] for run in seeds) if stage in found
            ]
            for stage in STAGES
        }
        rows.append(
            (METHODS[method], str(len(seeds)), millions(float(steps)), *(each(shares[name]) for name in STAGES))
        )
    return table(("", "seeds", "env steps", *STAGES), rows)


def each(shares: Sequence[float]) -> str:
    """The mean of shares, and in brackets each of them where there are several."""
    if not shares:
        return ""
    mean = percent(float(np.mean(shares)), 1)
    return mean if len(shares) == 1 else f"{mean} ({', '.join(f'{100 * share:.1f}' for share in shares)})"


_EPISODES = {
    "moved_fraction": "moved",
    "raised_fraction": "in the air",
    "lifted_fraction": "in the air at its end",
    "outside_fraction": "outside",
}
"""Columns by the ends of the metrics' names."""


def episodes_table(runs: Sequence[Run]) -> str:
    """What episodes of random skills do to the object: a row for each seed, the mean over the last tenth of its run.

    The last column is the largest share of episodes that ended outside in a hundredth of the run, from its second
    quarter on: where a run swings.
    """
    rows: list[Row] = []
    for method, seeds in by_method(runs).items():
        for run in seeds:
            series, late = run["series"], len(run["series"]["env_steps"])
            shares = [
                percent(float(np.mean(series[f"skills/{name}"][-(late // 10) :])))
                if f"skills/{name}" in series
                else "-"
                for name in _EPISODES
            ]
            most = percent(float(np.max(series["skills/outside_fraction"][late // 4 :])))
            rows.append((METHODS[method], str(run["config"]["seed"]), *shares, most))
    return table(("", "seed", *_EPISODES.values(), "most outside"), rows)


def phi_table(result: Mapping[str, Any]) -> str:
    """How far steps of the object go in phi, of each set of skills of ``benchmarks.steps_in_phi``."""
    upward = [f"upward at {100 * height:g} cm" for height in result["heights_m"]]
    rows: list[Row] = [
        (
            METHODS[each["method"]],
            each["name"].rpartition("-")[2],
            *(f"{step:.2f}" for step in (each["sideways"], *each["upward"])),
            f"{each['table_to_top']:.1f}",
        )
        for each in sorted(result["skills"], key=lambda each: list(METHODS).index(each["method"]))
    ]
    return table(("", "seed", "sideways on the table", *upward, "from the table to the top"), rows)
