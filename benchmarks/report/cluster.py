"""Blocks of ``docs/results/cluster.md``, in Markdown, from recorded files. Verdicts are computed from the numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.report.markdown import duration, measured_on, percent, table

Result = Mapping[str, Any]

MIN_RATIO, MAX_IDLE, MAX_MEAN_LAG, MAX_LAG, MIN_OVERLAPPED = 0.85, 0.10, 1.0, 2.0, 0.9
ACTOR_BACK_S, LEARNER_BACK_S = 10.0, 30.0
WITHIN_NOISE = 1.5
"""The disturbed curve may be so many times as far from undisturbed ones as those are from each other."""
MAX_P99_MS, MAX_SLOW_DOWN, REQUESTS_PER_S = 10.0, 0.02, 200.0
NUM_ROUNDS = 50_000
_NAMES = {"actor": "rollout actor", "generator": "task generator", "status": "status actor", "redis": "Redis"}


Target = tuple[str, str, str, bool | None]
"""What was asked for, how much, what was measured, and whether it was reached; None: not measured."""


def targets_table(found: Mapping[str, Result]) -> str:
    """All targets of the recorded results, by the name of their benchmark, and whether they were reached."""
    makers = {"cluster_throughput": _throughput_targets, "chaos": _chaos_targets, "rest_load": _rest_targets,
              "soak": _soak_targets}  # fmt: skip
    targets = [target for name, maker in makers.items() if name in found for target in maker(found[name])]
    rows = [(*words, verdict(reached)) for *words, reached in targets]
    return table(("", "asked", "measured", ""), rows) if rows else ""


def verdict(reached: bool | None) -> str:
    """Verdict for a cell."""
    return "not measured" if reached is None else "reached" if reached else "**missed**"


def _throughput_targets(result: Result) -> list[Target]:
    ratio, ray, overlapped = result["ratio"], result["ray"], result["broadcast"]["overlapped_share"]
    lag, idle = ray["policy_lag"], ray["learner_idle_share"]
    return [
        ("env steps/s, Ray / local", f">= {percent(MIN_RATIO)}", _spread(ratio), ratio["median"] >= MIN_RATIO),
        ("learner idle", f"< {percent(MAX_IDLE)}", percent(idle), idle < MAX_IDLE),
        ("mean policy lag", f"<= {MAX_MEAN_LAG:g}", f"{lag['mean']:.2f}", lag["mean"] <= MAX_MEAN_LAG),
        ("greatest policy lag", f"<= {MAX_LAG:g}", f"{lag['max']:g}", lag["max"] <= MAX_LAG),
        ("updates and broadcasts overlapped with acting", f">= {percent(MIN_OVERLAPPED)}", percent(overlapped),
         overlapped >= MIN_OVERLAPPED),
    ]  # fmt: skip


def _chaos_targets(result: Result) -> list[Target]:
    ended, account, redis = result["ended"], result["account"], result["redis"]
    handed, left = account["num_handed_by_the_dead"], account["num_left_at_the_end"]
    missed, twice = handed - account["num_counted_of_the_dead"], account["num_counted"] - account["num_in_ledger"]
    whole, went_on = redis["history_complete"], redis["iterations_meanwhile"]
    finished = ended["exit_code"] == 0 and ended["state"] == "finished"
    compared = result["compared"]["bob/success_rate"]
    away, most = compared["disturbed_from_undisturbed"], max(compared["undisturbed_from_each_other"])
    mean = sum(away) / len(away)
    curve = f"<= {WITHIN_NOISE:g} x {most:.3f}, as far as undisturbed ones are apart"
    return [
        ("the run that is shot at ends by itself", "finished", ended["state"], finished),
        ("rollouts lost after hand-over", "0", f"{missed} of {handed} by actors that were killed", missed == 0 <= left),
        ("rollouts counted twice", "0", f"{twice} of {account['num_counted']}", twice == 0),
        ("records complete", "yes", "yes" if account["complete"] else "no", account["complete"]),
        _back("rollout actor", result["recovery"]["actor"], ACTOR_BACK_S),
        _back("learner", result["recovery"]["learner"], LEARNER_BACK_S),
        ("iterations while Redis is away", "> 0", str(went_on), went_on > 0),
        ("Redis has the whole history again", "yes", "yes" if whole else "no", whole),
        ("success curve, distance from undisturbed", curve, f"{mean:.3f}", mean <= WITHIN_NOISE * most),
    ]


def _back(what: str, found: Mapping[str, Any], seconds: float) -> Target:
    worst, median = found["up_s"]["worst"], found["up_s"]["median"]
    words = f"{worst:.1f} s at worst, {median:.1f} s as a rule ({found['back']} of {found['killed']})"
    return f"{what} back", f"<= {seconds:g} s", words, worst <= seconds and found["back"] == found["killed"]


def _rest_targets(result: Result) -> list[Target]:
    p99, slow, rate = result["answered"]["all"]["p99_ms"], result["slow_down"], result["requests_per_s"]
    asked, failed = result["settings"]["rate"], result["num_failed"]
    answered = rate >= 0.98 * asked and asked >= REQUESTS_PER_S and failed == 0
    return [
        ("requests a second, all answered", f"{REQUESTS_PER_S:.0f}", f"{rate:.0f}, {failed} failed", answered),
        ("p99 of all routes", f"< {MAX_P99_MS:g} ms", f"{p99:.1f} ms", p99 < MAX_P99_MS),
        ("the training slows by", f"< {percent(MAX_SLOW_DOWN)}", _spread(slow), slow["median"] < MAX_SLOW_DOWN),
    ]


def _soak_targets(result: Result) -> list[Target]:
    num = result["num_rounds"]
    rows: list[Target] = [("rounds of tiny games", f">= {NUM_ROUNDS:,}", f"{num:,}", num >= NUM_ROUNDS)]
    for what, key in {"memory flat": "flat", "file descriptors and threads flat": "descriptors_flat"}.items():
        grown = [name for name, each in result["processes"].items() if not each[key]]
        rows.append((what, "every process", f"all but {', '.join(grown)}" if grown else "all", not grown))
    return rows


def _spread(each: Mapping[str, Any]) -> str:
    return f"{percent(each['median'], 1)} ({percent(each['least'], 1)} to {percent(each['greatest'], 1)})"


# --- blocks -----------------------------------------------------------------------------------------------------------


def throughput_block(result: Result) -> str:
    """Rates and shares of both runners, and what weights take."""
    ray, local, rows, sent = result["ray"], result["local"], result["rows"], result["broadcast"]
    rates = table(
        ("", "Ray", "local"),
        [
            ("env steps/s", *(f"{rows[name]['env_steps_per_s']:,.0f}" for name in ("ray", "local"))),
            ("env steps per CPU second", *(f"{rows[name]['env_steps_per_cpu_s']:,.0f}" for name in ("ray", "local"))),
            ("actors", str(ray["num_actors"]), "one process"),
            ("an iteration", f"{ray['iteration_s']:.2f} s", f"{local['iteration_s']:.2f} s"),
            ("of it, an update", f"{ray['learn_s']:.2f} s", f"{local['learn_s']:.2f} s"),
            ("learner idle", percent(ray["learner_idle_share"]), percent(local["learner_idle_share"])),
            ("actors idle", percent(ray["actor_idle_share"]), ""),
            ("of it, waiting for the learner", percent(ray["slot_wait_share"]), ""),
            ("policy lag, mean (max)", *(f"{each['policy_lag']['mean']:.2f} ({each['policy_lag']['max']:g})"
                                         for each in (ray, local))),
        ],
    )  # fmt: skip
    words = (
        f"{len(rows['ray']['env_steps_per_s_each'])} pairs of measurements in turn, "
        f"{result['settings']['num_iterations']} iterations each. One `ray.put` of the weights takes "
        f"{1000 * sent['put_s']:.1f} ms and all actors have them {1000 * sent['delivered_s']:.1f} ms later, together "
        f"{percent(sent['share_of_iteration'], 2)} of an iteration (a call without them: "
        f"{1000 * sent['idle_call_s']:.1f} ms)."
    )
    return f"{rates}\n\n{words}{measured_on(result['machine'])}"


def chaos_words(result: Result) -> str:
    """End of the run that was shot at, and its account of rollouts."""
    account, redis, calm = result["account"], result["redis"], result["curves"]["undisturbed"][0]
    shot = result["curves"]["disturbed"]
    return (
        f"{len(result['strikes'])} of {result['num_planned']} planned faults. The run took {duration(shot['wall_s'])} "
        f"for {shot['env_steps']:,} env steps, undisturbed {duration(calm['wall_s'])}, and published "
        f"`{result['ended']['published']}`. The driver counted {account['num_counted']:,} rollouts, the learner's "
        f"ledger {account['num_in_ledger']:,}; {account['num_refused']} were refused. Actors that were killed had "
        f"handed over {account['num_handed_by_the_dead']:,}, of which {account['num_counted_of_the_dead']:,} were "
        "learned from; "
        f"{account['num_left_at_the_end']} came too late for the last update. Redis was away for "
        f"{_seconds(redis['away_s'])}: {redis['iterations_meanwhile']} iterations meanwhile, status "
        f"{'said so' if redis['status_said_so'] else 'did not say so'}, told again "
        f"{_seconds(redis['told_again_s'])} after its return.{measured_on(result['machine'])}"
    )


def faults_table(result: Result) -> str:
    """Every fault with its recovery."""
    rows = [
        (f"{each['at']:.0f} s", each["name"] if each["target"] == "actor" else _NAMES.get(each["target"], each["name"]),
         f"{each['num_env_steps']:,}", _seconds(each["up_s"]), _seconds(each["working_s"]))
        for each in result["strikes"]
    ]  # fmt: skip
    return table(("at", "killed", "env steps so far", "another is up after", "and has done its work after"), rows)


def latency_table(result: Result) -> str:
    """Latencies by route."""
    head = ("route", "requests", "p50", "p90", "p99", "max")
    rows = [
        (route, f"{each['num']:,}", *(f"{each[key]:.1f} ms" for key in ("p50_ms", "p90_ms", "p99_ms", "max_ms")))
        for route, each in result["answered"].items()
    ]
    return table(head, rows)


def rest_words(result: Result) -> str:
    """Cost of the load for the training."""
    slow, cores, settings = result["slow_down"], result["cores"], result["settings"]
    error = f", standard error {percent(slow['standard_error'], 1)}" if slow["standard_error"] is not None else ""
    return (
        f"{settings['num_windows']} windows of {settings['window_s']:g} s with requests, each between two without. The "
        f"training made {_spread(slow)} fewer env steps a second with them (mean {percent(slow['mean'], 1)}{error}); "
        f"windows without, next to each other, differ by {percent(slow['between_calm_neighbours'], 1)}. The client "
        "took "
        f"{cores['client']:.2f} of a core on the same machine; the service and Redis took {cores['service_more']:.2f} "
        f"of a core more than without load, {percent(result['service_share_of_cores'], 1)} of all cores: what it would "
        f"cost a training with every core busy, were the client elsewhere. The client itself sent 99 % of requests "
        f"within {result['sent_late_p99_ms']:.1f} ms of their schedule; that counts in the "
        f"table.{measured_on(result['machine'])}"
    )


def soak_words(result: Result) -> str:
    """Length of the soak."""
    asked = result["asked"]
    return (
        f"{result['num_rounds']:,} rounds and {result['num_iterations']:,} updates in {duration(result['seconds'])}; "
        f"{result['num_replaced']} workers replaced, {result['num_refused']} rollouts refused, the status service "
        f"asked {asked['num']:,} times ({asked['unanswered']} unanswered). A day of a real run has "
        f"{result['iterations_a_day']:,.0f} updates.{measured_on(result['machine'])}"
    )


def soak_table(result: Result) -> str:
    """Memory of every process in the middle, at the end, and by the day."""
    head = ("process", "in the middle", "at the end", "in a day, 95 % interval", "its history", "files", "")
    rows = [
        (name, f"{each['middle_mb']:.1f} MB", f"{each['end_mb']:.1f} MB",
         f"{each['per_day_mb']:+.1f} MB [{each['per_day_low_mb']:+.1f}, {each['per_day_high_mb']:+.1f}]",
         f"{each['history_mb']:.1f} MB" if each["history_mb"] else "",
         f"{each['num_files']['middle']} to {each['num_files']['end']}",
         "flat" if each["flat"] and each["descriptors_flat"] else "**grows**")
        for name, each in result["processes"].items()
    ]  # fmt: skip
    return table(head, rows)


def _seconds(value: float | None) -> str:
    return "not within the run" if value is None else f"{value:.1f} s"
