"""Train a recipe with several seeds, and measure the averaged Bob of each at some env steps.

    python -m benchmarks.seeds panda-cube --seeds 10-14 --at 3.2,5,10 --json docs/results/seeds/panda-cube.json

A seed is one run in ``RUNS/NAME-SEED`` to the last of ``--at``, million env steps; what was stopped goes on from there.
Measured is the checkpoint nearest to each of them, on 1,000 fresh goals of each kind. The file also keeps the run's own
evaluations, of 300 goals every 100 updates. A seed that the file has is not run again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.measuring import ROOT, machine, one_line_errors, write_json
from benchmarks.record_run import play_task, tasks_in
from benchmarks.trials import learn
from service.base.errors import TandemError
from service.base.version import git_commit
from service.config.load import load_config
from service.config.self_play import SelfPlayConfig
from service.media.figures import read_records
from service.policies.numpy_policy import numpy_bob
from service.runs.grid import parse_seeds
from service.store.checkpoints import read_checkpoint
from service.store.run_directory import RunDirectory

KINDS = ("mixed", "table", "air", "larger", "one")
"""Of goals, where the world has them: the last is for several objects."""
NUM_EPISODES, SEED = 1_000, 1
"""Of what is measured; the seed of the goals is another than those of evaluations during a run."""
NUM_EVALUATED = 300
"""Goals of an evaluation during a run."""
BOB = "learner/bob_ema/"


def seed_config(recipe: str, seed: int, env_steps: int, settings: Sequence[str]) -> SelfPlayConfig:
    """The recipe with a seed, and with all checkpoints kept."""
    kept = ("run.keep_checkpoints=1000", f"run.evaluation_episodes={NUM_EVALUATED}")
    path = ROOT / "configs" / "pretrain" / f"{recipe.replace('-', '_')}.yaml"
    config = load_config(path, [*settings, *kept, f"seed={seed}", f"run.total_env_steps={env_steps}"])
    assert isinstance(config, SelfPlayConfig)
    return config


def measure(directory: RunDirectory, config: SelfPlayConfig, at: Sequence[float]) -> list[dict[str, Any]]:
    """Success at the last step, at any step, of the averaged Bob of the checkpoints nearest to some env steps."""
    files = {int(read_checkpoint(file).meta["env_steps"]): file for file in directory.checkpoints.glob("*.safetensors")}
    rows, tasks = [], {kind: task for kind, task in tasks_in(config.world).items() if kind in KINDS}
    for asked in at:
        env_steps = min(files, key=lambda found: abs(found - asked))
        arrays = read_checkpoint(files[env_steps]).arrays
        bob = numpy_bob({name.removeprefix(BOB): array for name, array in arrays.items() if name.startswith(BOB)})
        row: dict[str, Any] = {"asked": asked, "env_steps": env_steps}
        for kind, task in tasks.items():
            found = play_task(bob, task, config, NUM_EPISODES, SEED)
            row[kind] = {"last": found.success_last, "ever": found.success_ever}
        rows.append(row)
    return rows


def curve(directory: RunDirectory) -> list[dict[str, float]]:
    """The run's own evaluations."""
    rows = read_records(directory.metrics_file)
    names = {f"evaluation/{kind}_success_last": kind for kind in KINDS}
    kept = {"env_steps": "env_steps", "time/wall_s": "wall_s", "alice/lifted_fraction": "lifted", **names}
    return [{kept[name]: row[name] for name in kept if name in row} for row in rows if next(iter(names)) in row]


def record(
    recipe: str, seeds: Sequence[int], at: Sequence[float], settings: Sequence[str], file: Path, runs: Path
) -> None:
    """Train and measure those seeds that the file lacks; see the head of this module.

    Args:
        recipe: name of a file of configs/pretrain.
        seeds: of the runs.
        at: env steps at which Bob is measured; a run ends at the last.
        settings: overrides.
        file: for results.
        runs: directory of runs.

    Raises:
        TandemError: the file has other settings.
    """
    made_by = {"recipe": seed_config(recipe, 0, 1, settings).model_dump(mode="json"), "set": list(settings)}
    for seed in seeds:
        config = seed_config(recipe, seed, round(max(at)), settings)
        result: dict[str, Any] = {"benchmark": "seeds", "settings": made_by, "runs": []}
        if file.exists():
            result = json.loads(file.read_text(encoding="utf-8"))
        if result["settings"] != made_by:
            raise TandemError(f"{file}: its seeds had other settings; name another file")
        if seed in {run["seed"] for run in result["runs"]}:
            continue
        where, path = machine(), runs / f"{file.stem}-{seed}"
        directory, _ = learn(config, runs / "registry", path)
        run: dict[str, Any] = {"seed": seed, "measured": measure(directory, config, at), "curve": curve(directory)}
        run |= {"git_commit": git_commit(), "machine": where}
        if file.exists():  # another process may have run another seed meanwhile
            result = json.loads(file.read_text(encoding="utf-8"))
        result["runs"] = sorted([*result["runs"], run], key=lambda each: each["seed"])
        write_json(file, result)
        for row in run["measured"]:
            rates = ", ".join(f"{kind} {100 * row[kind]['last']:.1f}" for kind in KINDS if kind in row)
            print(f"{file.stem}, seed {seed} at {row['env_steps'] / 1e6:.2f} M: {rates}", flush=True)


@one_line_errors
def main() -> int:
    """Parse the command line, train, measure, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("recipe", metavar="RECIPE", help="name of a file of configs/pretrain")
    parser.add_argument("--seeds", required=True, metavar="0,1,2|0-4")
    parser.add_argument("--at", required=True, metavar="3.2,5", help="million env steps; a run ends at the last")
    parser.add_argument("--set", action="append", default=[], metavar="A.B=C", help="override; repeatable")
    parser.add_argument("--runs", type=Path, default=Path("runs/seeds"), metavar="DIR", help="default: %(default)s")
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="results; seeds it has are not run")
    given = parser.parse_args()
    at = [float(each) * 1e6 for each in given.at.split(",")]
    record(given.recipe, parse_seeds(given.seeds), at, given.set, given.json, given.runs)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
