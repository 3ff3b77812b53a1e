"""Blocks about a deployment, robots and speed, in Markdown, each from one recorded file."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median
from typing import Any

from benchmarks.report.markdown import measured_on, percent
from service.base.markdown import table

Result = Mapping[str, Any]


def ratios_block(result: Result) -> str:
    """A row for each ratio of two rates, and where they were measured."""
    rows = [
        (name, f"{each['median']:.2f}", f"{each['least']:.2f} to {each['greatest']:.2f}", f"{each['cpu']:.2f}")
        for name, each in result["ratios"].items()
    ]
    head = ("env steps/s", "median", "all turns", "by CPU time")
    return f"{table(head, rows)}\n\n`{result['benchmark']}`:{measured_on(result['machine'])}"


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
            each["seen"],
            f"{each['seconds']:.0f} s",
            "" if each["outcome"] == "passed" else "**failed**",
        )
        for each in result["checks"]
    ]
    return table(("what must be so", "what was seen", "took", ""), rows)


def robots_table(result: Result) -> str:
    """Picks, speed and self-play of every robot."""
    rows = []
    panda = 9  # joints, with those of the fingers
    for name, each in result["robots"].items():
        picks, speed, run = (each.get(key) for key in ("picks", "speed_to_panda", "run"))
        rows.append(
            (
                name,
                f"{picks['held']} of {picks['num']}" if picks else "",
                ", ".join(
                    f"{ratio['median']:.2f} ({ratio['median'] * each['num_joints'] / panda:.2f}) with {num} worlds"
                    for num, ratio in (speed or {}).items()
                ),
                _self_play(run) if run else "not run",
            )
        )
    head = (
        "robot",
        "cubes picked, carried and held",
        "env steps (times joints, with fingers), the Panda's = 1",
        "self-play",
    )
    return table(head, rows)


def robots_words(result: Result) -> str:
    """What was measured, and where."""
    return (
        "A hand-written policy picks a cube up, carries it into the air and holds it for 5 s, within 1 cm. Env steps "
        "are of random actions with one thread. Self-play is the Panda's recipe of that day, one seed; shares are "
        "means over its last 200,000 env steps. The mesh is a frustum: its sides lean by 9 degrees, and a grip by hand "
        f"loses it more often.{measured_on(result['machine'])}"
    )


def speed_words(result: Result) -> str:
    """What the Panda's worlds cost before and after robots became descriptions."""
    ratios = " and ".join(f"{each['cpu']:.2f} with {num}" for num, each in result["ratios"].items())
    old, new = (result["commits"][key][:7] for key in ("old", "new"))
    where, num_pairs = result["machine"], result["settings"]["num_pairs"]
    return (
        f"The Panda's worlds make {ratios} worlds times as many env steps in a CPU second as before robots were "
        f"descriptions: commit `{new}` by `{old}`, random actions in the recipe's world, one thread, median of "
        f"{num_pairs} pairs in turn. On {where['num_cpus']} cores of {where['cpu']}, {where['time'][:10]}."
    )


def own_task_table(trials: Mapping[str, Result]) -> str:
    """A user's task: each method with its success and its time."""
    rows = []
    for trial in sorted(trials.values(), key=lambda each: float(each["env_steps"])):
        found, there = trial["evaluation"], next((at for at in trial["curve"] if at["success_last"] >= 0.95), None)
        rows.append(
            (
                f"`{trial['cell']['method']}`",
                f"{trial['env_steps']:,}",
                f"{trial['wall_s'] / 60:.1f}" if trial["env_steps"] else "",
                f"{there['wall_s'] / 60:.1f}" if there else "",
                f"{percent(found['success_last'], 1)} of {found['num_episodes']:,}",
                f"{percent(found['success_last_low'], 1)} to {percent(found['success_last_high'], 1)}",
            )
        )
    head = ("method", "env steps", "minutes", "minutes until 95 of 100 goals", "success", "95 % interval")
    return table(head, rows)


def demo_table(result: Result) -> str:
    """What became of the demo, by seed."""
    rows = [
        (
            str(run["seed"]),
            "four of five goals, twice in a row" if run["made_it"] else "the time was over",
            f"{run['learning_minutes']:.1f}",
            f"{run['minutes']:.1f}",
            f"{run['env_steps'] / 1e6:.2f} M",
            percent(run["curve"][-1][2]),
        )
        for run in result["runs"]
    ]
    return table(("seed", "ended by", "minutes of learning", "in all", "env steps", "last evaluation"), rows)


def demo_words(result: Result) -> str:
    """How many seeds made it, and what watching costs."""
    made, cost = [run["made_it"] for run in result["runs"]], result["cost"]
    ratios = [alone / watched for alone, watched in zip(cost["alone_s"], cost["watched_s"], strict=True)]
    return (
        f"{sum(made)} of {len(made)} seeds made it within eight minutes. With somebody who watches, and evaluations "
        f"every 60 updates, the demo makes {median(ratios):.2f} times the env steps/s of the recipe alone (median of "
        f"{len(ratios)} pairs of runs; {min(ratios):.2f} to {max(ratios):.2f}).{measured_on(result['machine'])}"
    )


def _self_play(run: Result) -> str:
    shares = {key: f"{100 * run[key]:.0f} %" for key in ("valid_fraction", "lifted_fraction", "success_rate")}
    return (
        f"after {run['env_steps'] / 1e6:.1f} M env steps {shares['valid_fraction']} of Alice's goals are valid and "
        f"{shares['lifted_fraction']} in the air; Bob reaches {shares['success_rate']}"
    )
