"""Wall-clock time until Bob solves 90 % of mixed goals, from the start of the process, for several seeds.

    python -m benchmarks.time_to_skill --seeds 30-34 --json docs/results/time_to_skill.json

with ``--set run.evaluation_interval=50 --set run.evaluation_episodes=300`` as the recorded one.

What counts is the first of three evaluations in a row with 90 % of mixed goals at the last step, by the run's own
evaluations. Seeds run one after the other, each until it is there or at ``--max-env-steps``. A seed that the
file has is not run again, unless it was not there within fewer env steps. The machine should do nothing else.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.measuring import RECIPE_FILE, machine, one_line_errors, write_json
from benchmarks.processes import cpu_s_by_role
from benchmarks.training_process import Training, overrides, scratch
from service.base.errors import TandemError
from service.config import load_config
from service.config.self_play import SelfPlayConfig
from service.runs.grid import parse_seeds

SHARE = 0.9
NUM_IN_A_ROW = 3
SUCCESS = "evaluation/mixed_success_last"


def first_in_a_row(rates: Sequence[float]) -> int | None:
    """Index of the first of three neighbours that all reach the share; None if there are none."""
    starts = range(len(rates) - NUM_IN_A_ROW + 1)
    return next((index for index in starts if min(rates[index : index + NUM_IN_A_ROW]) >= SHARE), None)


def run_seed(config: Path, settings: Sequence[str], seed: int, max_env_steps: int) -> dict[str, Any]:
    """Run one seed of a recipe until it is there, or to ``max_env_steps``; for JSON."""
    budget = overrides({"seed": seed, "run.total_env_steps": max_env_steps})
    given = [word for each in settings for word in ("--set", each)]
    points: list[dict[str, float]] = []
    with scratch() as home:
        start_s = time.monotonic()
        arguments = ["--config", str(config), "--no-publish", *given, *budget]
        with Training(home, arguments, runtime="local") as training:
            found, rows = None, list[dict[str, float]]()
            while found is None and (not rows or rows[-1]["env_steps"] < max_env_steps):
                rows = training.wait_for(training.records.new, 600.0)
                seen_s, cpu_s = time.monotonic() - start_s, sum(cpu_s_by_role(training.pid).values())
                times = {"wall_s": seen_s, "cpu_s": cpu_s}
                points += [
                    {"success": row[SUCCESS], "env_steps": row["env_steps"], "iteration": row["iteration"]} | times
                    for row in rows
                    if SUCCESS in row
                ]
                found = first_in_a_row([each["success"] for each in points])
    there = points[found] if found is not None else None
    return {"seed": seed, "reached": there is not None, "max_env_steps": max_env_steps, "at": there, "curve": points}


def report(result: Mapping[str, Any]) -> str:
    """A row for each seed, as Markdown, and the median of their times."""
    lines = ["| seed | minutes | known after | env steps | updates | CPU minutes |", "|" + " --- |" * 6]
    for run in result["runs"]:
        if (at := run["at"]) is None:
            last = run["curve"][-1] if run["curve"] else {"env_steps": 0}
            cells = f"not within {last['env_steps'] / 1e6:.1f} M env steps | | | | "
        else:
            known = run["curve"][run["curve"].index(at) + NUM_IN_A_ROW - 1]
            steps = f"{at['env_steps'] / 1e6:.2f} M | {at['iteration']:.0f}"
            cells = f"{at['wall_s'] / 60:.1f} | {known['wall_s'] / 60:.1f} | {steps} | {at['cpu_s'] / 60:.1f} "
        lines.append(f"| {run['seed']} | {cells}|")
    median_s = statistics.median(times_s(result))
    if math.isfinite(median_s):
        lines += ["", f"Median: {median_s / 60:.1f} minutes; a seed that did not reach it counts as infinite."]
    return "\n".join(lines)


def times_s(result: Mapping[str, Any]) -> list[float]:
    """Seconds of each seed; infinite where it was not there."""
    return [run["at"]["wall_s"] if run["reached"] else math.inf for run in result["runs"]]


def words(result: Mapping[str, Any]) -> str:
    """The times in a sentence, for the README."""
    found = times_s(result)
    there = sorted(each / 60.0 for each in found if math.isfinite(each))
    times = f"{there[0]:.1f} to {there[-1]:.1f} minutes" if there else "no time measured"
    if math.isfinite(median_s := statistics.median(found)):
        times += f", {median_s / 60.0:.1f} at the median"
    cores = result["runs"][0]["machine"]["num_cpus"]
    return f"{len(there)} of {len(found)} solve {100 * SHARE:.0f} % after {times}, on {cores} cores."


@one_line_errors
def main() -> int:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--set", action="append", default=[], metavar="A.B=C", help="override; repeatable")
    parser.add_argument("--seeds", default="0-4", metavar="0,1,2|0-4", help="default: %(default)s")
    parser.add_argument("--max-env-steps", type=int, default=12_000_000, help="default: %(default)s")
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="results; seeds it has are not run")
    given = parser.parse_args()
    config = load_config(RECIPE_FILE, given.set)
    assert isinstance(config, SelfPlayConfig)
    settings = {
        "config": RECIPE_FILE.name,
        "set": given.set,
        "num_worlds": config.game.num_worlds,
        "share": SHARE,
        "recipe": config.model_dump(mode="json"),
    }
    result: dict[str, Any] = {"benchmark": "time_to_skill", "settings": settings, "runs": []}
    if given.json.exists():
        result = json.loads(given.json.read_text(encoding="utf-8"))
        if result["settings"] != settings:
            before = result["settings"]
            named = ", ".join(key for key, value in settings.items() if before.get(key) != value)
            raise TandemError(f"{given.json}: its seeds had something else as {named}; name another file")
    budget = given.max_env_steps
    done = {run["seed"] for run in result["runs"] if run["reached"] or run["max_env_steps"] >= budget}
    for seed in parse_seeds(given.seeds):
        if seed not in done:
            where = machine()
            run = run_seed(RECIPE_FILE, given.set, seed, budget)
            others = [each for each in result["runs"] if each["seed"] != seed]
            result["runs"] = sorted([*others, run | {"machine": where}], key=lambda each: each["seed"])
            write_json(given.json, result)
            print(report(result), flush=True)
    print(report(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
