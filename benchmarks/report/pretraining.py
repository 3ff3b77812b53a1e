"""Tables of ``docs/results/pretraining.md`` and ``pretraining-v1.md``, in Markdown, from recorded runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from statistics import fmean, median
from typing import Any

from benchmarks.record_run import ASKED, ASKED_RATES, ASKED_STEPS, TASKS
from benchmarks.report.markdown import Row, commit, duration, millions, percent
from benchmarks.run_files import RANDOM, STAGES, Records, Run, binned, mean_share, steps_until, unthin
from benchmarks.seeds import KINDS, NUM_EPISODES
from benchmarks.why_alice import ARMS
from service.base.intervals import rate_of
from service.base.markdown import table
from service.config.self_play import SelfPlayConfig
from service.registry.bundled import BUNDLED
from service.registry.digest import parameters_digest
from service.registry.loading import load

NUM_BINS = 10
"""Equal parts of a run's env steps; rates are those of the last, distances and heights also those of the first."""
CHAMPION = "panda-cube@champion"
WHY_KINDS = ("mixed", "table", "air")
"""Goals by which arms are judged."""
ASKED_OF_SEVERAL = {"one": 0.93, "table": 0.80, "air": 0.60}
"""Success at the last step that we ask of a Bob with two objects."""
DIPS_FROM = 4e6
"""Env steps from which on two evaluations in a row below what is asked for are a dip."""
DIGITS = 12
"""Of a digest on a page, as in the table of tasks."""
NUM_LAST = 5
"""Evaluations at the end of a run, of which Alice's share of lifted goals is the mean."""


def champion_words(seeds: Mapping[str, Any]) -> str:
    """The bundled champion: its version, digest, seed, and what its manifest says it solved when it was published.

    Args:
        seeds: recorded seeds of the recipe, of which it is one.
    """
    bob = load(CHAMPION, BUNDLED)
    assert bob.manifest is not None  # it is a published version
    assert isinstance(bob.config, SelfPlayConfig)
    manifest, config = bob.manifest, bob.config
    seed, known = manifest.config["seed"], {run["seed"] for run in seeds["runs"]}
    told = f"seed {seed} of the table above" if seed in known else f"seed {seed}, which is not recorded"
    rates = ", ".join(
        f"{percent(manifest.metrics[f'evaluation/{goals}_success_last'], 1)} of {goals}"
        for goals in ("mixed", "air", "table")
    )
    return (
        f"`{CHAMPION}`, in the package, is version {manifest.version}, {told}: "
        f"{config.policy.bob.num_primitives} primitives, {millions(manifest.metrics['env_steps'])} env steps, "
        f"parameters `{parameters_digest(bob.primitives)[:DIGITS]}`. When it was published it had {rates} "
        f"goals, {config.run.final_episodes} of each."
    )


def tasks_table(runs: Sequence[Run]) -> str:
    """Bob on every task, at the last step, with the 95 % Wilson interval; below, what is asked, and doing nothing.

    Bold is what is below what was asked.
    """
    head = ("run", *TASKS, f"env steps until {percent(ASKED)} of mixed")
    rows = [(str(run["name"]), *_judged(run["evaluations"]), _steps_to_asked(run)) for run in runs]
    idle = max((tasks_cells(run["evaluations"], idle=True) for run in runs), key=lambda cells: sum(map(bool, cells)))
    asked = (percent(ASKED_RATES[task]) for task in TASKS)
    return table(head, [*rows, ("asked for", *asked, millions(ASKED_STEPS)), ("doing nothing", *idle, "")])


def tasks_cells(evaluations: Records, *, idle: bool = False) -> list[str]:
    """Success at the last step on each task, empty where it was not measured."""
    rows = {row["goals"]: row for row in evaluations if (row["policy"] == "idle") == idle}
    return [_success(rows[task]) if task in rows else "" for task in TASKS]


def _judged(evaluations: Records) -> list[str]:
    rates = {row["goals"]: row["success_last"] for row in evaluations if row["policy"] != "idle"}
    cells = zip(TASKS, tasks_cells(evaluations), strict=True)
    return [f"**{cell}**" if cell and rates[task] < ASKED_RATES[task] else cell for task, cell in cells]


def seeds_block(study: Mapping[str, Any]) -> str:
    """What ``benchmarks.seeds`` recorded: a row for each seed, and how many there are of what is asked for."""
    rates = ", ".join(f"{percent(rate)} of {kind}" for kind, rate in _asked(study).items())
    return f"{_seeds_table(study)}\n\nAt least {rates} goals: {_how_many(study)} env steps."


def _seeds_table(study: Mapping[str, Any]) -> str:
    at = sorted({row["asked"] for run in study["runs"] for row in run["measured"]})
    kinds = [kind for kind in KINDS if kind in study["runs"][0]["measured"][0]]
    names = ", ".join("*Larger*" if kind == "larger" else kind for kind in kinds)
    judged = {} if "one" in kinds else {"dips": dips}
    head = ("seed", *(f"{millions(asked)}: {names}" for asked in at), *judged, "Alice lifts")
    rows = []
    for run in study["runs"]:
        found = {row["asked"]: row for row in run["measured"]}
        cells = [", ".join(f"{100 * found[a][kind]['last']:.1f}" for kind in kinds) if a in found else "" for a in at]
        lifts = [point["lifted"] for point in run["curve"][-NUM_LAST:]]
        rows.append(
            (str(run["seed"]), *cells, *(judge(run["curve"]) for judge in judged.values()), percent(fmean(lifts)))
        )
    return table(head, rows)


def _asked(study: Mapping[str, Any]) -> dict[str, float]:
    """Rates that are asked of its runs, by the kind of goals."""
    several = "one" in study["runs"][0]["measured"][0]
    return ASKED_OF_SEVERAL if several else {"mixed": ASKED_RATES["mixed"]}


def _how_many(study: Mapping[str, Any]) -> str:
    """How many runs solve what is asked, at each number of env steps."""
    counts, rates = [], _asked(study)
    for asked in sorted({row["asked"] for run in study["runs"] for row in run["measured"]}):
        rows = [row for run in study["runs"] for row in run["measured"] if row["asked"] == asked]
        enough = sum(all(row[kind]["last"] >= rate for kind, rate in rates.items()) for row in rows)
        counts.append(f"{enough} of {len(rows)} at {millions(asked)}")
    return ", ".join(counts)


def seeds_words(study: Mapping[str, Any]) -> str:
    """The same in a sentence for the README, and how long the longest runs took."""
    asked = percent(ASKED_RATES["mixed"])
    most = max(row["asked"] for run in study["runs"] for row in run["measured"])
    longest = [run for run in study["runs"] if run["measured"][-1]["asked"] == most]
    minutes = [run["curve"][-1]["wall_s"] / 60 for run in longest]
    took = f"{min(minutes):.0f} to {max(minutes):.0f} minutes, {median(minutes):.0f} at the median"
    return (
        f"Runs that solve {asked} of random goals or more (no setting was tuned on their seeds):\n"
        f"{_how_many(study)} env steps ([each seed](docs/results/pretraining.md#every-seed)). "
        f"{millions(most)}: {took}."
    )


def other_seeds(name: str, study: Mapping[str, Any]) -> str:
    """The same of another recipe than the one that ships, and when it was recorded."""
    commits = ", ".join(sorted({commit(run["git_commit"]) for run in study["runs"]}))
    when = ", ".join(sorted({run["machine"]["time"][:10] for run in study["runs"]}))
    return f"`{name}`, {commits}, {when}:\n\n{seeds_block(study)}"


def larger_updates(study: Mapping[str, Any], larger: Mapping[str, Any]) -> str:
    """Seeds of a recipe that were also run with more worlds: both, with the worlds of an update.

    Args:
        study: recorded seeds of the recipe.
        larger: of the same with another ``game.num_worlds``.
    """
    both = {each["settings"]["recipe"]["game"]["num_worlds"]: each["runs"] for each in (study, larger)}
    rows = [
        {**run, "seed": f"{run['seed']}, {num_worlds} worlds"}
        for again in larger["runs"]
        for num_worlds, runs in sorted(both.items())
        for run in runs
        if run["seed"] == again["seed"]
    ]
    return _seeds_table({"runs": rows})


def why_alice_table(studies: Mapping[str, Mapping[str, Any]]) -> str:
    """What is left of success without a part of self-play: the mean of the seeds and its interval, at the last step.

    Args:
        studies: recorded seeds by the names of the arms.
    """
    asked = ASKED_RATES["mixed"]
    head = ("", *WHY_KINDS, f"at least {percent(asked)} of mixed")
    rows = []
    for name, arm in ARMS.items():
        if name not in studies:
            continue
        found = [run["measured"][-1] for run in studies[name]["runs"]]
        rates = (rate_of([_evaluated(row[kind]["last"]) for row in found]) for kind in WHY_KINDS)
        enough = sum(row["mixed"]["last"] >= asked for row in found)
        rows.append((arm.title, *(str(rate).replace("*", "\\*") for rate in rates), f"{enough} of {len(found)}"))
    return table(head, rows) if rows else ""


def why_alice_words(studies: Mapping[str, Mapping[str, Any]]) -> str:
    """The same of mixed goals, in a sentence for the README; nothing while an arm is not recorded.

    Args:
        studies: recorded seeds by the names of the arms.
    """
    if not studies.keys() >= ARMS.keys():
        return ""
    rates = {
        name: [100 * run["measured"][-1]["mixed"]["last"] for run in study["runs"]] for name, study in studies.items()
    }
    mean = {name: f"{fmean(each):.0f} %" for name, each in rates.items()}
    random, num_seeds = rates["uniform-new-alice"], len(rates["recipe"])
    return (
        f"[Why Alice](docs/results/pretraining.md#why-alice): Bob solves {mean['recipe']} of random goals; "
        f"{mean['no-cloning']} without cloning her turns; "
        f"{mean['no-difficulty']} if she earns nothing by his failures."
        f"\nIf goals from the whole workspace are added, he solves {mean['uniform']}; {mean['uniform-new-alice']} "
        f"({min(random):.0f} to {max(random):.0f} by seed) if Alice does not learn, "
        f"{mean['uniform-alone']} without Alice (means of the {num_seeds} tuning seeds)."
    )


def _evaluated(rate: float) -> dict[str, Any]:
    return {"evaluation": {"success_last": rate, "num_episodes": NUM_EPISODES}}


def dips(curve: Sequence[Mapping[str, float]]) -> str:
    """How many evaluations of mixed goals after ``DIPS_FROM`` are below what is asked for, as the one before them.

    Such as ``1 of 15``; empty where there were none that could be.
    """
    pairs = list(pairwise(row["mixed"] for row in curve if row["env_steps"] >= DIPS_FROM))
    return f"{sum(max(pair) < ASKED_RATES['mixed'] for pair in pairs)} of {len(pairs)}" if pairs else ""


def training_table(runs: Sequence[Run]) -> str:
    """What each run was, its time, and rates of its Alice and Bob in the last tenth of it."""
    head = ("run", "seed", "primitives", "worlds", "env steps", "time", "valid goals", "of those, lifted",
            "Bob on valid goals", "goal distance", "goal height, 9 of 10 below")  # fmt: skip
    return table(head, [_training_row(run) for run in runs])


def _training_row(run: Run) -> Row:
    records, config = unthin(run["series"]), run["config"]

    def change(key: str) -> str:
        first, *_, last = 100 * binned(records, key, NUM_BINS)
        return f"{first:.1f} to {last:.1f} cm"

    return (
        str(run["name"]),
        *(str(number) for number in (config["seed"], config["policy"]["bob"]["num_primitives"])),
        str(config["game"]["num_worlds"]),
        millions(records[-1]["env_steps"]),
        duration(records[-1]["time/wall_s"]),
        *(_at_end(records, key) for key in ("alice/valid_fraction", "alice/lifted_fraction", "bob/success_rate")),
        change("alice/goal_distance_m"),
        change("alice/goal_height_p90_m"),
    )


def coverage_table(runs: Sequence[Run]) -> str:
    """Share of the table's cells that random compositions visit at each stage, beside the random policy."""
    head = ("run", RANDOM, *STAGES, f"end / {RANDOM}")
    return table(head, [_coverage_row(run) for run in runs if run.get("coverage")])


def _coverage_row(run: Run) -> Row:
    stages = run["coverage"]["stages"]
    shares = {name: mean_share(stage) for name, stage in stages.items()}
    cells = [percent(shares[name]) if name in shares else "" for name in (RANDOM, *STAGES)]
    return (str(run["name"]), *cells, f"{shares['end'] / shares[RANDOM]:.1f}")


def throughput_words(result: Mapping[str, Any]) -> str:
    """A sentence from what ``compare_commits.py`` measured."""
    before, now = (f"{row['env_steps_per_s']:,.0f} env steps/s ({name})" for name, row in result["rows"].items())
    ratio, settings = result["ratio"], result["settings"]
    return (
        f"The whole learning loop makes {now} instead of {before}, each commit with its own configuration after "
        f"{millions(settings['trained_steps'])} env steps of training: {ratio['median']:.2f} times as many "
        f"({ratio['least']:.2f} to {ratio['greatest']:.2f} in {settings['num_pairs']} pairs of measurements; "
        f"{ratio['cpu']:.2f} by CPU time)."
    )


def _at_end(records: Records, key: str) -> str:
    """A rate in the last tenth of a run."""
    return percent(binned(records, key, NUM_BINS)[-1])


def _success(row: dict[str, Any]) -> str:
    low, high = (100 * row[f"success_last_{end}"] for end in ("low", "high"))
    return f"{percent(row['success_last'])} [{low:.0f}, {high:.0f}]"


def _steps_to_asked(run: Run) -> str:
    records = unthin(run["series"])
    if not any("evaluation/mixed_success_last" in record for record in records):
        return ""
    found = steps_until(records, "evaluation/mixed_success_last", ASKED)
    return millions(found) if found else f"not in {millions(records[-1]['env_steps'])}"
