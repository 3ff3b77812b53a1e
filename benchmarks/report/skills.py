"""Tables of ``docs/results/skills.md``, in Markdown: where random skills take the object, and controls of self-play."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from benchmarks.controls import CONTROLS, OURS, TASKS
from benchmarks.report.markdown import Row, millions, percent, table
from benchmarks.report.recipe import differences
from benchmarks.run_files import RANDOM, STAGES, Run, mean_share, unthin
from service.envs.tasks import find_task

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
_ALIKE: dict[str, dict[str, tuple[str, str]]] = {
    OURS: {},
    "uniform-alice": {"generator.goal_source": ("uniform", "alice")},
}
"""How the recipe of a control differs from that of ours."""
MIXED, TABLE = "evaluation/mixed_success_last", "evaluation/table_success_last"


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
    head = ("goals proposed by", "seeds", "Bob's env steps", "all env steps", "updates", *_EVALUATED,
            *(find_task(task).title for task in TASKS))  # fmt: skip
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
                f"{np.mean([run['series']['iteration'][-1] for run in seeds]):,.0f}",
                *(each([bob[goals]["success_last"] for bob in bobs]) for goals in _EVALUATED),
                *(each([run["downstream"][task]["evaluation"]["success_last"] for run in seeds]) for task in TASKS),
            )
        )
    return table(head, rows)


def alike_table(runs: Sequence[Run]) -> str:
    """Alice's goals, and uniform ones beside hers, at equal env steps: also the runs behind the table of tasks.

    All runs whose recipe is that of the control ours, or that with uniform goals.
    """
    first = next((run["config"] for run in runs if run.get("control") == OURS), None)
    if first is None:
        return ""
    rows: list[Row] = []
    for name, changed in _ALIKE.items():
        alike = [run for run in runs if differences(run["config"], first) == changed]
        rows += [(_PROPOSERS[name], *_alike_row(run)) for run in alike]
    head = ("goals proposed by", "run", "seed", "mixed", "table", "least of mixed from 3 M on", "valid goals lifted")
    words = (
        "At equal env steps, 9 to 10 million of both players: means of the evaluations during the run, 100 goals each, "
        "and of the share of Alice's valid goals that are in the air. *Least* is of any million env steps from 3 "
        "million on."
    )
    return f"{words}\n\n{table(head, rows)}"


def _alike_row(run: Run) -> Row:
    records = unthin(run["series"])

    def mean(key: str, million: int) -> float:
        values = [each[key] for each in records if key in each and million < each["env_steps"] / 1e6 <= million + 1]
        return float(np.mean(values)) if values else float("nan")

    least = min(mean(MIXED, million) for million in range(3, 10))
    last = (mean(MIXED, 9), mean(TABLE, 9), least, mean("alice/lifted_fraction", 9))
    name = f"control {run['name']}" if "control" in run else str(run["name"])
    return (name, str(run["config"]["seed"]), *(percent(share) for share in last))


def each(shares: Sequence[float]) -> str:
    """The mean of shares, and in brackets each of them where there are several."""
    if not shares:
        return ""
    mean = percent(float(np.mean(shares)), 1)
    return mean if len(shares) == 1 else f"{mean} ({', '.join(f'{100 * share:.1f}' for share in shares)})"
