"""What Alice is for: self-play without one of its parts, several seeds each, measured as ``benchmarks.seeds`` does.

    python -m benchmarks.why_alice --seeds 20-24

Every arm gives Bob as many env steps and updates: where Alice does not play, a run has those of its env steps that are
Bob's in the recipe. Results are ``docs/results/why_alice/ARM.json``; what was stopped goes on, and what is there is not
run again.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from benchmarks.measuring import ROOT, one_line_errors
from benchmarks.seeds import record
from service.runs.grid import parse_seeds

RECIPE, OUT = "panda-cube", ROOT / "docs" / "results" / "why_alice"
ENV_STEPS = 4_000_000
BOB_SHARE = 0.597
"""Of the env steps of the recipe that are Bob's, in its first 4 million (seed 30); it hardly changes."""
_UNIFORM = "generator.goal_source=uniform"


@dataclass(frozen=True, slots=True)
class Arm:
    """Self-play with something left out or in its place."""

    title: str
    settings: tuple[str, ...] = ()
    env_steps: int = ENV_STEPS


ARMS = {
    "recipe": Arm("the recipe"),
    "uniform": Arm("goals from the whole workspace beside hers", (_UNIFORM,)),
    "uniform-new-alice": Arm(
        "the same, beside an Alice who never learns",
        (_UNIFORM, "learner.alice.value_first_updates=1000000000", "learner.self_imitation.weight=0"),
    ),
    "uniform-alone": Arm(
        "goals from the whole workspace, without her",
        (_UNIFORM, "game.alice_plays=false"),
        round(BOB_SHARE * ENV_STEPS),
    ),
    "no-cloning": Arm("the recipe, and Bob clones nothing", ("learner.abc.weight=0",)),
    "no-difficulty": Arm("the recipe, and she is not paid where he fails", ("game.alice_difficult_reward=0",)),
}
"""By the names of their files."""


@one_line_errors
def main() -> int:
    """Parse the command line, train and measure what is missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", required=True, metavar="20-24")
    parser.add_argument("--arms", metavar="NAME,NAME", default=",".join(ARMS), help="default: all")
    parser.add_argument("--set", action="append", default=[], metavar="A.B=C", help="override; repeatable")
    parser.add_argument("--runs", type=Path, default=Path("runs/why_alice"), metavar="DIR", help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=OUT, metavar="DIR", help="for the recorded files")
    given = parser.parse_args()
    for seed in parse_seeds(given.seeds):
        for name in given.arms.split(","):
            arm = ARMS[name]
            settings = [*arm.settings, *given.set]
            record(RECIPE, [seed], [arm.env_steps], settings, given.out / f"{name}.json", given.runs)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
