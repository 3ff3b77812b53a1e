"""Blocks of ``docs/scaling.md``, in Markdown, from ``scaling.json``."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from benchmarks.report.markdown import commit, millions, percent, table
from benchmarks.scaling_model import ACTORS, Batch, Cost, Model, Prediction, fastest, limit, predict

Result = Mapping[str, Any]
CORES = (2, 4, 16, 64, 256)
PREDICTED = (1, 2, 4, 16, 256, 4096)
"""Numbers of actors."""
NAMED = (16, 256, 4096)
"""Those for which the time of every part is shown."""
WORLDS_EACH = 120
"""Worlds of each actor where every actor brings as many."""
SHARED_WORLDS = 240
"""Worlds in all where actors share them out."""
RECIPE = "recipe"
"""Name of the file of the recipe without any change, which other sizes of update are compared with."""
MIN_SEEDS = 3
"""Seeds that a size of update needs to be called faster than another: they differ by millions of env steps."""


def box_block(result: Result) -> str:
    """One box."""
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


def constants_block(result: Result) -> str:
    """Costs of every part."""
    head = ("", "an update", "and each rollout", "and each world of it", "and each actor at each rollout")
    rows = [
        (name, *(_time(cost[key]) for key in ("update_s", "rollout_s", "world_s", "pair_s")))
        for name, cost in result["model"]["constants"].items()
    ]
    assumed = result["assumed"]
    words = (
        f"Assumed, not measured: a node receives {assumed['network_mb_per_s']:g} MB/s (two Ray nodes on one box do, so "
        f"a cluster does better), a node has {assumed['actors_per_node']} actors."
    )
    return f"{table(head, rows)}\n\n{words}"


def model_block(result: Result) -> str:
    """Predictions: as many worlds for each actor, and the same worlds shared out."""
    model = _model(result)
    each = [predict(model, num, WORLDS_EACH) for num in PREDICTED]
    shared = [predict(model, num, max(1, -(-SHARED_WORLDS // num))) for num in PREDICTED]
    return (
        f"Every actor brings {WORLDS_EACH} worlds, so that more actors make larger updates:\n\n{_predictions(each)}\n\n"
        f"The same experiment shared out, {SHARED_WORLDS} worlds in all and at least one for each actor:\n\n"
        f"{_predictions(shared)}"
    )


def batches_block(studies: Mapping[str, Result]) -> str:
    """Env steps and updates until the skill, by worlds of an update; medians, a seed that was not there is infinite."""
    head = ("worlds", "recorded in", "seeds that were there", "env steps", "updates", "the recipe's, same seeds")
    rows = []
    for name, study in sorted(studies.items(), key=lambda item: item[1]["settings"]["num_worlds"]):
        seeds = {run["seed"] for run in study["runs"]}
        same = [run for run in studies[RECIPE]["runs"] if run["seed"] in seeds]
        there = f"{sum(run['reached'] for run in study['runs'])} of {len(seeds)}"
        steps, updates = _median(study["runs"], "env_steps"), _median(study["runs"], "iteration")
        numbers = _number(steps, millions), _number(updates), _number(_median(same, "iteration"))
        rows.append([str(study["settings"]["num_worlds"]), f"`{name}.json`", there, *numbers])
    return table(head, rows)


def skill_block(result: Result, studies: Mapping[str, Result]) -> str:
    """Time to a skill on many cores: the model's seconds of an update, and how many updates a study took."""
    model = _model(result)
    found = [
        Batch(study["settings"]["num_worlds"], _median(study["runs"], "iteration"))
        for study in studies.values()
        if len(study["runs"]) >= MIN_SEEDS
    ]
    head = ("cores", "worlds in all", "actors", "an update every", "minutes", "core-hours of those used")
    rows = []
    for num_cores in CORES:
        way = fastest(model, found, num_cores)
        rows.append(
            (str(num_cores), str(way.batch.num_worlds), str(way.run.num_actors), f"{way.run.update_s:.3f} s",
             f"{way.seconds / 60:.1f}", f"{way.seconds * way.run.num_cores / 3600:.2f}")
        )  # fmt: skip
    return f"{table(head, rows)}\n\n**A run gets shorter up to {way.run.num_cores} cores.**"


def _median(runs: Sequence[Mapping[str, Any]], key: str) -> float:
    """Median of what the skill took; a seed that was not there never is."""
    return float(statistics.median(run["at"][key] if run["reached"] else math.inf for run in runs))


def _number(value: float, write: Callable[[float], str] = "{:,.0f}".format) -> str:
    return write(value) if math.isfinite(value) else ""


def _model(result: Result) -> Model:
    costs = {name: Cost(**cost) for name, cost in result["model"]["constants"].items()}
    return Model(costs.pop(ACTORS), costs, result["model"]["env_steps_per_world"])


def _predictions(rows: Sequence[Prediction]) -> str:
    head = ("actors", "worlds of each", "env steps/s", "of one actor's", "an update every", "actors busy",
            "learner idle", "bottleneck")  # fmt: skip
    return table(
        head,
        [
            (f"{row.num_actors:,}", f"{row.num_worlds:g}", f"{row.env_steps_per_s:,.0f}",
             f"{row.env_steps_per_s / rows[0].env_steps_per_s:.1f}", f"{_seconds(row.update_s)} s",
             percent(row.busy(ACTORS), 1), percent(1.0 - row.busy("learner")), row.bottleneck)
            for row in rows
        ],
    )  # fmt: skip


def limits_block(result: Result) -> str:
    """The first bottleneck, the next ones, and how busy each part is with many actors."""
    model = _model(result)
    found = {name: limit(model, name, WORLDS_EACH) for name in model.parts}
    limits = dict(sorted(found.items(), key=lambda item: math.inf if item[1] is None else item[1]))
    first, most = next(iter(limits.items()))
    rows = {num: predict(model, num, WORLDS_EACH) for num in NAMED}
    head = ("part", "keeps up with", *(f"seconds an update, {num:,} actors" for num in NAMED))
    parts = table(
        head,
        [
            (name, _actors(most_actors), *(_seconds(rows[num].seconds[name]) for num in NAMED))
            for name, most_actors in limits.items()
        ],
    )
    playing = rows[NAMED[0]].seconds[ACTORS]
    words = f"**The first bottleneck is the {first}**: it keeps up with {_actors(most)}"
    sizes = result["alone"]["sizes"]
    world = sizes["rollout"] / sizes["num_worlds"]
    held = ", ".join(f"{_mb(num * WORLDS_EACH * world)} with {num:,}" for num in NAMED)
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
