"""Blocks of ``docs/scaling.md``, in Markdown, from ``scaling.json``."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

from benchmarks.report.markdown import commit, measured_on, millions, percent, table
from benchmarks.scaling_model import ACTORS, Batch, Cost, Model, Ranks, fastest
from service.media.figures import counted

Result = Mapping[str, Any]
CORES = (16, 64, 256)
NAMED = (16, 256, 4096)
"""Numbers of actors for which the time of every part is shown."""


def box_block(result: Result) -> str:
    """One box, and several nodes on it."""
    rows = []
    for num, each in result["one_box"].items():
        spent = {role: 1e6 * cores / each["env_steps_per_s"] for role, cores in each["cores"].items()}
        rows.append(
            (num, f"{each['num_worlds']}", f"{each['env_steps_per_s']:,.0f}", f"{each['iteration_s']:.2f} s",
             percent(each["learner_idle_share"]), percent(each["actor_idle_share"]),
             f"{sum(each['cores'].values()):.2f} of {result['machine']['num_cpus']}",
             f"{sum(spent.values()):.0f} us", f"{spent['actor']:.0f} us", f"{spent['learner']:.0f} us")
        )  # fmt: skip
    head = ("actors", "worlds of each", "env steps/s", "an iteration", "learner idle", "actors idle", "cores busy",
            "CPU time of an env step", "in actors", "in the learner")  # fmt: skip
    where = result["machine"]
    words = f"{where['cpu']}, {where['num_cpus']} cores, {commit(where['git_commit'])}, {where['time'][:10]}."
    return f"{words}\n\n{table(head, rows)}"


def nodes_block(result: Result) -> str:
    """A run on many nodes that are processes, with ranks that are killed and hang."""
    settings, strikes = result["settings"], result["strikes"]
    words = {"kill": "killed", "stop": "stopped, so that it hangs"}
    rows = [(each["name"], words[each["how"]], f"{each['back_s']:.0f} s") for each in strikes]
    wrong = result["num_rollouts_handed_over"] - result["num_rollouts_counted"]
    return (
        f"{counted(settings['actors'], 'tiny actor')} and a learner of {counted(settings['ranks'], 'rank')} on "
        f"{counted(settings['nodes'], 'node')} beside a head, {counted(result['num_iterations'], 'update')}:\n\n"
        f"{table(('process', 'was', 'next update after'), rows)}\n\n"
        f"Rollouts that actors handed over: {result['num_rollouts_handed_over']:,}; that the learner counted: "
        f"{result['num_rollouts_counted']:,}; lost or counted twice: {abs(wrong):,}."
        f"{measured_on(result['machine'])}"
    )


def constants_block(result: Result) -> str:
    """Costs of every part."""
    head = ("", "an update", "and each rollout", "and each world of it", "and each actor at each rollout")
    rows = [
        (name, *(_time(cost[key]) for key in ("update_s", "rollout_s", "world_s", "pair_s")))
        for name, cost in result["model"]["constants"].items()
    ]
    assumed, ranks = result["assumed"], ""
    if "alone" in result:
        messages = result["alone"]["messages"]
        two_s, four_s = messages["message_s"]
        ranks = (
            f"Messages of an update between ranks: {messages['num_messages']}, of {_time(two_s)} between two ranks and "
            f"{_time(four_s)} between four.\n\n"
        )
    words = (
        f"Assumed, not measured: a node receives {assumed['network_mb_per_s']:g} MB/s (two Ray nodes on one box do, so "
        f"a cluster does better), a node has {assumed['actors_per_node']} actors."
    )
    return f"{table(head, rows)}\n\n{ranks}{words}"


def model_block(result: Result) -> str:
    """Predictions: as many worlds for each actor, and the same worlds shared out."""
    model = result["model"]
    num, total = model["worlds_each"][0]["num_worlds"], model.get("shared_worlds", 240)
    ranks = ", and the learner has as many ranks as keep up with them" if "ranks" in model else ""
    return (
        f"Every actor brings {num} worlds, so that more actors make larger updates{ranks}:\n\n"
        f"{_predictions(model['worlds_each'])}\n\n"
        f"The same experiment shared out, {total} worlds in all and at least one for each actor:\n\n"
        f"{_predictions(model['worlds_shared'])}"
    )


def batches_block(studies: Mapping[str, Result]) -> str:
    """Env steps and updates until the skill, by worlds of an update; medians over the seeds that were there."""
    head = ("worlds", "recorded in", "seeds that were there", "env steps", "updates")
    rows = []
    for name, study in sorted(studies.items(), key=lambda item: item[1]["settings"]["num_worlds"]):
        there, num_seeds = _there(study), len(study["runs"])
        row = [str(study["settings"]["num_worlds"]), f"`{name}.json`", f"{len(there)} of {num_seeds}", "", ""]
        if there:
            row[-2:] = millions(statistics.median(at["env_steps"] for at in there)), f"{_updates(study):,.0f}"
        rows.append(row)
    return table(head, rows)


def skill_block(result: Result, studies: Mapping[str, Result]) -> str:
    """Time to a skill on many cores: the model's seconds of an update, and how many updates a study took."""
    model = result["model"]
    costs = {name: Cost(**cost) for name, cost in model["constants"].items()}
    actor = costs.pop(ACTORS)
    ranks, per_node = Ranks(**model["ranks"]), result["assumed"]["actors_per_node"]
    made = Model(actor, costs, model["env_steps_per_world"], ranks, per_node)
    found = [Batch(study["settings"]["num_worlds"], _updates(study)) for study in studies.values() if _there(study)]
    head = ("cores", "worlds in all", "actors", "ranks", "an update every", "minutes", "core-hours")
    rows = []
    for num_cores in CORES:
        way = fastest(made, found, num_cores)
        rows.append(
            (str(num_cores), str(way.batch.num_worlds), str(way.run.num_actors), str(way.run.num_ranks),
             f"{way.run.update_s:.3f} s",
             f"{way.seconds / 60:.1f}", f"{way.seconds * num_cores / 3600:.2f}")
        )  # fmt: skip
    return table(head, rows)


def _there(study: Result) -> list[Mapping[str, Any]]:
    """Where the seeds of a study had the skill."""
    return [run["at"] for run in study["runs"] if run["reached"]]


def _updates(study: Result) -> float:
    """Median of the updates until the skill."""
    return float(statistics.median(at["iteration"] for at in _there(study)))


def _predictions(rows: list[Mapping[str, Any]]) -> str:
    head = ("actors", "ranks", "worlds of each", "env steps/s", "of one actor's", "an update every", "actors busy",
            "learner idle", "bottleneck")  # fmt: skip
    return table(
        head,
        [
            (f"{row['num_actors']:,}", f"{row.get('num_ranks', 1):,}", f"{row['num_worlds']:g}",
             f"{row['env_steps_per_s']:,.0f}", f"{row['env_steps_per_s'] / rows[0]['env_steps_per_s']:.1f}",
             f"{_seconds(row['update_s'])} s", percent(row["actors_busy"], 1), percent(row["learner_idle"]),
             row["bottleneck"])
            for row in rows
        ],
    )  # fmt: skip


def limits_block(result: Result) -> str:
    """The first bottleneck, the next ones, and how busy each part is with many actors."""
    model = result["model"]
    limits = model["limits"]
    first, most = next(iter(limits.items()))
    rows = {row["num_actors"]: row for row in model.get("one_rank", model["worlds_each"])}
    head = ("part", "keeps up with", *(f"seconds an update, {num:,} actors" for num in NAMED))
    parts = table(
        head,
        [
            (name, _actors(most_actors), *(_seconds(rows[num]["seconds"][name]) for num in NAMED))
            for name, most_actors in limits.items()
        ],
    )
    playing = rows[NAMED[0]]["seconds"]["actors"]
    words = f"**The first bottleneck is the {first}**: it keeps up with {_actors(most)}"
    sizes = result.get("alone", result)["sizes"]  # results from before ranks have no part of that name
    world = sizes["rollout"] / sizes["num_worlds"]
    held = ", ".join(f"{_mb(num * rows[num]['num_worlds'] * world)} with {num:,}" for num in NAMED)
    return (
        f"{words}, whose rounds take {playing:.2f} s. The rollouts of one update, which the learner holds in memory, "
        f"have {held}. In the order in which parts become one:\n\n{parts}"
    )


def _actors(num: int | None) -> str:
    return "any number" if num is None else f"{num:,} actor{'' if num == 1 else 's'}"


def _time(seconds: float) -> str:
    if seconds == 0.0:
        return ""
    for unit, scale in (("s", 1.0), ("ms", 1e3), ("us", 1e6)):
        if seconds * scale >= 1.0:
            return f"{seconds * scale:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def _mb(num_bytes: float) -> str:
    return f"{num_bytes / 1e6:.2f} MB" if num_bytes < 1e8 else f"{num_bytes / 1e9:,.1f} GB"


def _seconds(seconds: float) -> str:
    """Three digits, or all before the point."""
    return f"{seconds:,.0f}" if seconds >= 100 else f"{seconds:.3g}"
