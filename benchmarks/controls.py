"""Controls of self-play: the same Bob and learner, and goals that somebody else than Alice proposes.

    python -m benchmarks.controls uniform --seed 0
    python -m benchmarks.controls uniform-alice --seed 0

One control and seed is a pre-training run, three downstream trainings with its primitives, and a small file of both in
``docs/results/controls``. All controls give Bob the same number of env steps; where Alice plays as well, there are more
in all. What was stopped goes on from its directories; what has its file is not run again.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from benchmarks.measuring import RECIPE_FILE, ROOT, one_line_errors, write_json
from benchmarks.record_run import head_of, measure_tasks
from benchmarks.run_files import COUNTERS, Run, thin
from benchmarks.trials import NUM_EPISODES, learn, run_trial, trial_config
from service.config import Config, load_config
from service.media.figures import read_records
from service.registry.loading import load
from service.store.run_directory import RunDirectory

OURS = "ours"
_WITHOUT_ALICE = ("game.alice_plays=false", "generator.past_opponent_fraction=0")
CONTROLS: dict[str, tuple[str, ...]] = {
    OURS: (),
    "uniform": ("generator.goal_source=uniform", *_WITHOUT_ALICE),
    "uniform-alice": ("generator.goal_source=uniform",),
    "table": ("generator.goal_source=table", *_WITHOUT_ALICE),
    "learnable": ("generator.goal_source=learnable", *_WITHOUT_ALICE),
    "learnable-alice": ("generator.goal_source=learnable",),
}
"""Overrides of the recipe by name; with ``-alice`` there are her demonstrations and the goals she has just proposed."""
BOB_STEPS = 6_000_000
"""Bob's own env steps of every control: those of 10 million of self-play."""
BOB_SHARE = 0.6
"""Share of all env steps that are Bob's where Alice plays, by the recorded runs of the recipe; it hardly changes."""
TASKS, METHOD, TRIAL_STEPS = ("wall", "box", "push"), "ours-her", 300_000
"""What is learned with the primitives of a control."""
MAX_POINTS = 100
_KEPT = (*COUNTERS, "evaluation/", "bob/", "alice/valid_fraction", "alice/lifted_fraction")


def control_config(recipe: Path, name: str, seed: int, bob_steps: int, settings: list[str]) -> Config:
    """The recipe as a control has it."""
    alone = "game.alice_plays=false" in CONTROLS[name]
    steps = bob_steps if alone else round(bob_steps / BOB_SHARE)
    named = [] if name == OURS else [f"name=control-{name}"]  # ours may be the run that made the primitives of a seed
    numbers = [f"seed={seed}", f"run.total_env_steps={steps}"]
    return load_config(recipe, [*named, *numbers, *CONTROLS[name], *settings])


def record_control(directory: RunDirectory, name: str, downstream: dict[str, Any]) -> Run:
    """Everything that is kept of a control whose run has ended; ``downstream`` has results of its trials by task."""
    config, records = directory.read_config(), read_records(directory.metrics_file)
    bob = load(str(directory.path)).policy
    return head_of(config, f"{name}-{config.seed}") | {
        "control": name,
        "overrides": list(CONTROLS[name]),
        "env_steps": int(records[-1]["env_steps"]),
        "bob_env_steps": bob_env_steps(records),
        "evaluations": measure_tasks(bob, config, num_episodes=NUM_EPISODES),
        "downstream": {
            task: {key: result[key] for key in ("cell", "evaluation", "env_steps")}
            for task, result in downstream.items()
        },
        "series": thin(records, MAX_POINTS, _KEPT),
    }


def bob_env_steps(records: list[dict[str, Any]]) -> int:
    """Env steps that were Bob's, from a run's metrics."""
    total = before = 0.0
    for record in records:
        total += record["bob/env_steps_fraction"] * (record["env_steps"] - before)
        before = record["env_steps"]
    return round(total)


def run_control(config: Config, name: str, runs: Path, trial_steps: int = TRIAL_STEPS) -> Run:
    """Run, or go on with, what a control consists of, in directories below ``runs``."""
    path = runs / f"{name}-{config.seed}"
    directory, _ = learn(config, path, path)
    found = {}
    for task in TASKS:
        settings = [f"run.total_env_steps={trial_steps}", f"run.final_episodes={NUM_EPISODES}"]
        settings.append(f"run.num_threads={config.run.num_threads}")
        trial = trial_config(task, METHOD, config.seed, str(path.absolute()), settings)
        found[task] = run_trial(trial, path, runs / f"{name}-{config.seed}-{task}")
        print(f"  {task}: {found[task]['evaluation']['success_last']:.1%}", flush=True)
    return record_control(directory, name, found)


@one_line_errors
def main() -> int:
    """Parse the command line, run and record what is not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add, out = parser.add_argument, ROOT / "docs" / "results" / "controls"
    add("name", choices=CONTROLS)
    add("--seed", type=int, default=0, help="of the run and of its trials (default: %(default)s)")
    add("--set", dest="settings", metavar="A.B=C", action="append", default=[], help="repeatable")
    add("--run-dir", type=Path, metavar="DIR", default=Path("runs") / "controls", help="default: %(default)s")
    add("--out", type=Path, metavar="DIR", default=out, help="for the recorded files")
    given = parser.parse_args()
    file = given.out / f"{given.name}-{given.seed}.json"
    if file.exists():
        print(f"skipped, {file} is there")
        return 0
    config = control_config(RECIPE_FILE, given.name, given.seed, BOB_STEPS, given.settings)
    print(f"{given.name}: {', '.join(CONTROLS[given.name]) or 'nothing changed'}", flush=True)
    write_json(file, run_control(config, given.name, given.run_dir))
    print(f"{file}: {file.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
