"""Cost of self-play on top of its physics: the bare world, rounds with policies, and the whole loop, in turn.

    python -m benchmarks.selfplay_throughput --run-dir runs/cube --json docs/results/selfplay_throughput.json

All three make physics of the same kind and begin at one checkpoint. The whole loop, learning included, is measured in
a process of its own. Then rounds are played without learning, and after each round the bare world starts from the
states of that round and repeats its actions, bit for bit, because an arm that touches nothing is faster. Beside it
stands the same batch under random actions, every world always acting.

Without ``--run-dir`` a run is begun first, and is measured after some iterations. The policies of a run that has
learned touch the object more.
"""

from __future__ import annotations

import shutil
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.measuring import (
    RECIPE_FILE,
    Sample,
    describe_ratio,
    parser_of,
    rates,
    rates_table,
    ratio,
    run_benchmark,
)
from benchmarks.rounds import Rounds
from benchmarks.training_process import ENDLESS, Measured, Training, copy_run, measure_training, overrides, scratch
from service.io.run_directory import RunDirectory
from service.runs.train import open_run

BARE = "bare world"
BARE_RANDOM = "bare world, random actions"
ROLLOUT = "rollout with policies"
LOOP = "whole loop"
PACKAGES = ("mujoco", "numpy", "torch")


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of what is measured."""

    num_pairs: int = 5
    seconds: float = 12.0
    """Length of each measurement of rounds and, after each round, its physics; half as long for random actions."""
    num_iterations: int = 20
    """Length of each measurement of the whole loop, with the evaluations and checkpoints that fall into it."""
    num_warmup_iterations: int = 12
    """Iterations of a run that is begun; past opponents play from the 12th on."""


def begin_run(config: Path, home: Path, num_iterations: int) -> RunDirectory:
    """Begin a run and stop it after ``num_iterations``."""
    with Training(home, ["--config", str(config), *overrides(ENDLESS)], name="begun", runtime="local") as training:
        training.wait_until("iteration", num_iterations)
    return training.directory


def compare(source: RunDirectory, home: Path, settings: Settings) -> dict[str, Any]:
    """Measure everything in turn, from the newest checkpoint of ``source``; for JSON."""
    samples: dict[str, list[Sample]] = {name: [] for name in (BARE, BARE_RANDOM, ROLLOUT, LOOP)}
    loops: list[Measured] = []
    contacts: list[float] = []
    copy = copy_run(source, home, "rounds")
    run = open_run(copy.read_config(), copy, resume=True)
    rounds = Rounds(run)
    for _ in range(settings.num_pairs):
        loop_copy = copy_run(source, home, "loop")
        with Training(home, overrides(ENDLESS), name="loop", runtime="local") as training:
            loops.append(measure_training(training, settings.num_iterations))
        shutil.rmtree(loop_copy.path)
        whole, bare = rounds.play_and_repeat(settings.seconds)
        made = (bare, rounds.act_at_random(settings.seconds / 2), whole, loops[-1].sample)
        for each, sample in zip(samples.values(), made, strict=True):
            each.append(sample)
        contacts += [each.rollout.metrics["alice/contact_fraction"] for each in rounds.played]
    rounds.close()
    run.close()
    copy.close()
    learn_s = sum(each.num_iterations * each.learn_s for each in loops)
    return {
        "rows": {name: rates(each) for name, each in samples.items()},
        "ratios": {
            f"{ours} / {theirs}": ratio(samples[ours], samples[theirs])
            for ours in (ROLLOUT, LOOP)
            for theirs in (BARE, BARE_RANDOM)
        },
        "learner_idle_share": 1.0 - learn_s / sum(each.wall_s for each in loops),
        "policy_lag": {
            "mean": statistics.fmean(each.mean_policy_lag for each in loops),
            "max": max(each.max_policy_lag for each in loops),
        },
        "alice_contact_fraction": statistics.fmean(contacts),
    }


def benchmark(config: Path, run_dir: Path | None, settings: Settings) -> dict[str, Any]:
    """Everything, in directories that are deleted at the end."""
    with scratch() as home:
        begun = begin_run(config, home, settings.num_warmup_iterations) if run_dir is None else RunDirectory(run_dir)
        return compare(begun, home, settings)


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    lines = [rates_table(result["rows"])]
    lines += [describe_ratio(name, each) for name, each in result["ratios"].items()]
    lag = result["policy_lag"]
    lines += [
        f"learner idle: {result['learner_idle_share']:.1%} of the whole loop",
        f"policy lag: mean {lag['mean']:.2f}, max {lag['max']:.0f}",
        f"Alice touched the object in {result['alice_contact_fraction']:.0%} of her turns",
    ]
    return "\n".join(lines)


def main() -> int:
    """Parse the command line, measure, print."""
    parser = parser_of(__doc__, Settings())
    parser.add_argument("--config", type=Path, metavar="FILE", default=RECIPE_FILE, help="of a run that is begun")
    parser.add_argument("--run-dir", type=Path, metavar="DIR", help="go on from this run, with its configuration")
    given = parser.parse_args()
    return run_benchmark(
        "selfplay_throughput",
        PACKAGES,
        given,
        Settings,
        lambda settings: benchmark(given.config, given.run_dir, settings),
        report,
    )


if __name__ == "__main__":
    raise SystemExit(main())
