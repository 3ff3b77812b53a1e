"""Short runs of the shipped recipe with one thing changed or switched off, each recorded for ``docs/results``.

    python -m benchmarks.ablations --steps 3000000 --seed 0
    python -m benchmarks.ablations --steps 3000000 --seed 1 recipe no-abc

An ablation whose file is there already is skipped, and one that was stopped goes on from its run directory. What the
recipe does not have on cannot be switched off, and is skipped as well.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.measuring import RECIPE_FILE, ROOT, write_json
from benchmarks.record_run import measure_run, record_run
from benchmarks.run_files import COUNTERS, Run, thin
from service.config import Config, load_config
from service.errors import TandemError
from service.io.run_directory import RunDirectory
from service.media.figures import read_records
from service.runtime.local import LocalRun

RECIPE = "recipe"
ABLATIONS: dict[str, tuple[str, ...]] = {
    RECIPE: (),
    "no-abc": ("learner.abc.weight=0",),
    "one-goal": ("game.num_goals=1",),
    "no-past-opponents": ("generator.past_opponent_fraction=0",),
    "monolithic": ("policy.monolithic_bob={hidden_sizes: [256, 128]}",),
    "no-mirror": ("learner.bob.mirror=none", "learner.alice.mirror=none"),
    "no-replay-invalid": ("generator.replay_invalid=false",),
    "no-replay-over-cells": ("generator.replay_over_cells=false",),
    "no-average": ("learner.bob_ema_decay=0",),
    "no-blocked-gripper": ("game.blocked_gripper_fraction=0",),
    "no-replay-from-reset": ("generator.replay_from_reset=false",),
    "no-hold": ("game.bob_hold_steps=1",),
    "no-old-demonstrations": ("learner.abc.num_iterations=1",),
    "no-short-turns": ("game.alice_steps_min=null",),
    "no-hindsight": ("learner.abc.hindsight=false",),
    "decoupled-alice": ("learner.alice.decoupled=true",),
}
"""Overrides of the recipe by name of the ablation."""
MAX_POINTS = 100
"""Points of a series; these are small pictures."""
KEPT_ROOMS = ("alice/", "bob/", "evaluation/")


def ablated_config(recipe: Path, name: str, settings: list[str]) -> Config | None:
    """The recipe with an ablation's change; None where that changes nothing.

    Args:
        recipe: a YAML file.
        name: of the ablation.
        settings: ``a.b=c`` of all ablations, such as the seed.
    """
    if name not in ABLATIONS:
        raise TandemError(f"no ablation {name!r}; choose from {', '.join(ABLATIONS)}")
    config = load_config(recipe, [*settings, *ABLATIONS[name]])
    return None if name != RECIPE and config == load_config(recipe, settings) else config


def learn(config: Config, directory: RunDirectory) -> None:
    """Run to the end, or go on from where a run with this configuration stopped."""
    if directory.exists and directory.read_config() != config:
        raise TandemError(
            f"{directory.path} holds a run of another configuration; remove it, or name another --run-dir"
        )
    run = LocalRun(config, directory, resume=directory.exists)
    try:
        run.run(_show)
    finally:
        directory.close()


def record_ablation(directory: RunDirectory, name: str, ablation: str) -> Run:
    """Record ``name`` of a run that was one of ``ABLATIONS``: fewer points than of other runs, and no paths."""
    run = record_run(directory, name) | measure_run(directory)
    kept = [
        {key: value for key, value in record.items() if key in COUNTERS or key.startswith(KEPT_ROOMS)}
        for record in read_records(directory.metrics_file)
    ]
    if run["coverage"]:
        for stage in run["coverage"]["stages"].values():
            del stage["paths_mm"]
    what = {"name": ablation, "overrides": list(ABLATIONS[ablation])}
    return run | {"ablation": what, "series": thin(kept, MAX_POINTS), "goals": []}


def _show(metrics: dict[str, float]) -> None:
    if "evaluation/mixed_success_last" in metrics:
        rates = ", ".join(f"{kind} {metrics[f'evaluation/{kind}_success_last']:.0%}" for kind in ("mixed", "table"))
        print(f"  {metrics['env_steps']:>12,.0f} env steps, {metrics['time/wall_s']:.0f} s: {rates}", flush=True)


def main() -> int:
    """Parse the command line, run and record what is not there yet."""
    given = _parser().parse_args()
    settings = [*given.overrides, f"seed={given.seed}", f"run.total_env_steps={given.steps}"]
    try:
        names = given.names or list(ABLATIONS)
        configs = {name: ablated_config(given.config, name, settings) for name in names}  # all checked before one runs
        for name, config in configs.items():
            file = given.out / f"ablation-{name}-{given.seed}.json"
            print(f"{name}: {', '.join(ABLATIONS[name]) or 'nothing changed'}", flush=True)
            if file.exists() or config is None:
                print("  skipped, " + (f"{file} is there" if file.exists() else "the recipe does not have it on"))
                continue
            directory = RunDirectory(given.run_dir / f"{name}-{given.seed}")
            learn(config, directory)
            write_json(file, record_ablation(directory, file.stem, name))
            print(f"  {file}: {file.stat().st_size / 1000:.0f} kB", flush=True)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("names", metavar="NAME", nargs="*", help=f"default: all of {', '.join(ABLATIONS)}")
    add("--steps", type=int, required=True, help="env steps of each run")
    add("--seed", type=int, default=0, help="of each run (default: %(default)s)")
    add("--config", type=Path, metavar="FILE", default=RECIPE_FILE)
    add("--set", dest="overrides", metavar="A.B=C", action="append", default=[], help="for all of them; repeatable")
    add("--run-dir", type=Path, metavar="DIR", default=Path("runs") / "ablations", help="default: %(default)s")
    add("--out", type=Path, metavar="DIR", default=ROOT / "docs" / "results" / "runs", help="for the recorded files")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
