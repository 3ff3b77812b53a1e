"""Tables of ``docs/results/skills.md``, in Markdown: where random skills take the object, and controls of self-play."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from benchmarks.controls import CONTROLS, OURS, TASKS
from benchmarks.report.markdown import Row, millions, percent, table
from benchmarks.run_files import Run
from benchmarks.stages import RANDOM, STAGES, mean_share
from service.envs.tasks import TASKS as DOWNSTREAM

METHODS = {"ours": "ours", "metra": "METRA", "lsd": "LSD", "dads": "DADS", "diayn": "DIAYN"}
"""Names in tables and pictures by recorded method, in the order of rows."""
_EVALUATED = ("mixed", "air", "table")
_PROPOSERS = {
    OURS: "Alice, and her earlier goals",
    "uniform": "uniform in the workspace",
    "uniform-alice": "Alice, and uniform in the workspace",
    "table": "uniform on the table",
    "learnable": "uniform, by p (1 - p) of cells",
    "learnable-alice": "Alice, and uniform, by p (1 - p) of cells",
}


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


def controls_table(runs: Sequence[Run]) -> str:
    """A row for each control: its Bob on random goals, then his primitives downstream."""
    head = ("goals proposed by", "seeds", "Bob's env steps", "all env steps", *_EVALUATED,
            *(DOWNSTREAM[task].title for task in TASKS))  # fmt: skip
    rows = []
    for name in CONTROLS:
        seeds = sorted((run for run in runs if run["control"] == name), key=lambda run: int(run["config"]["seed"]))
        if not seeds:
            continue
        bobs = [{row["goals"]: row for row in run["evaluations"] if row["policy"] == "bob"} for run in seeds]
        rows.append(
            (
                _PROPOSERS[name],
                str(len(seeds)),
                *(millions(float(np.mean([run[key] for run in seeds]))) for key in ("bob_env_steps", "env_steps")),
                *(each([bob[goals]["success_last"] for bob in bobs]) for goals in _EVALUATED),
                *(each([run["downstream"][task]["evaluation"]["success_last"] for run in seeds]) for task in TASKS),
            )
        )
    return table(head, rows)


def each(shares: Sequence[float]) -> str:
    """The mean of shares, and in brackets each of them where there are several."""
    if not shares:
        return ""
    mean = percent(float(np.mean(shares)), 1)
    return mean if len(shares) == 1 else f"{mean} ({', '.join(f'{100 * share:.1f}' for share in shares)})"
