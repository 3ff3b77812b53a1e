"""Learn a task with a method and a seed, or play it where nothing is learned, and record what ``docs/results`` keeps.

    python -m benchmarks.trials wall ours-her 0 --primitives panda-cube@champion --out wall-ours-her-0.json

A method that learns has a run directory, ``RUNS/NAME``; what was stopped goes on from there. What has its file is not
run again. The file says what was measured and with which settings, and keeps the learning curve.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.measuring import one_line_errors, write_json
from benchmarks.report.results import TRIAL, Result
from benchmarks.run_files import FORMAT_VERSION
from service.actors.evaluation import DeterministicPolicy, IdlePolicy
from service.base.errors import TandemError
from service.base.jsonl import read_jsonl
from service.config import Config
from service.config.load import parse_config
from service.config.task import TaskConfig
from service.config.task_methods import find_method
from service.config.tree import apply_override
from service.envs.tasks import find_task
from service.methods.task_evaluation import FINAL_SEED, evaluate_on, numbers_of
from service.registry.loading import load
from service.runs.train import train
from service.store.run_directory import RunDirectory, encode_result

NUM_EPISODES = 1_000
"""Of the last evaluation."""


def trial_config(task: str, method: str, seed: int, primitives: str, settings: Sequence[str] = ()) -> TaskConfig:
    """Configuration of a trial; ``settings`` are overrides."""
    find_task(task)
    learns = find_method(method).learns  # what learns nothing is no method of a run
    tree: dict[str, Any] = {"task": task, "method": method if learns else "ours"}
    tree |= {"seed": seed, "primitives": primitives, "run": {"final_episodes": NUM_EPISODES}}
    for setting in settings:
        apply_override(tree, setting)
    config = parse_config(tree, where=f"{method} on {task}")
    assert isinstance(config, TaskConfig)
    return config.model_copy(update={"method": method})


def run_trial(config: TaskConfig, registry: Path, path: Path) -> Result:
    """Learn in a run directory, or go on there, or play where nothing is learned; what is recorded."""
    begun = config.begin(registry, None)
    if not find_method(config.method).learns:
        return _recorded(begun, registry, _play(begun, registry), [])
    directory, result = learn(begun, registry, path)
    return _recorded(begun, registry, result, read_jsonl(directory.metrics_file))


def learn(config: Config, registry: Path, path: Path) -> tuple[RunDirectory, dict[str, Any]]:
    """Train in a run directory, or go on there until it has its result; both."""
    directory = RunDirectory(path)
    if directory.exists and directory.read_config() != config:
        raise TandemError(f"{path} holds a run of another configuration; remove it, or name another directory")
    if (result := directory.read_result() if directory.exists else None) is None:
        train(config, directory, registry, resume=directory.exists, publish=False, on_iteration=lambda _: None)
        if (result := directory.read_result()) is None:
            raise TandemError(f"{path}: stopped before its end; the same command goes on from there")
    return directory, result


def _play(config: TaskConfig, registry: Path) -> dict[str, Any]:
    """What ``result.json`` has of a method that learns nothing."""
    idle = config.method == "idle"
    player: DeterministicPolicy = IdlePolicy() if idle else load(config.primitives, registry).player()
    num, seed = config.run.final_episodes, config.seed + FINAL_SEED
    found = evaluate_on(find_task(config.task, config.code), config.world, player, num, seed, config.run.num_threads)
    return dict(json.loads(encode_result({"evaluation": {**numbers_of(found)}, "env_steps": 0, "wall_s": 0.0})))


def _recorded(config: TaskConfig, registry: Path, result: dict[str, Any], records: Sequence[dict[str, Any]]) -> Result:
    """The file of a trial from its configuration, its ``result.json`` and its metrics."""
    run, trained = config.run, load(config.primitives, registry)
    before = None if trained.manifest is None else trained.manifest.metrics.get("env_steps")
    primitives = {"name": trained.name, "digest": trained.digest, "env_steps": before}
    settings = {
        "task": config.task,
        "method": config.method,
        "seed": config.seed,
        "num_env_steps": run.total_env_steps,
        "sac": config.sac.model_dump(mode="json"),
        "curve_every": run.evaluation_interval,
        "curve_episodes": run.evaluation_episodes,
        "reward_margin_m": config.reward_margin_m,
        "num_episodes": run.final_episodes,
        "task_version": config.task_version,
    }
    curve = [
        {
            "env_steps": each["env_steps"],
            "wall_s": each["time/wall_s"],
            **{key: each[f"evaluation/{key}"] for key in ("success_last", "success_ever")},
        }
        for each in records
        if "evaluation/success_last" in each
    ]
    return {
        "format_version": FORMAT_VERSION,
        TRIAL: settings,
        "primitives": primitives if find_method(config.method).takes is not None else None,
        "world": trained.config.world.model_dump(mode="json"),
        "evaluation": {"goals": find_task(config.task, config.code).goal_kind, **result["evaluation"]},
        "made": {**result["made"], "num_threads": run.num_threads},
        **{key: result[key] for key in ("env_steps", "wall_s")},
        "curve": curve,
    }


@one_line_errors
def main() -> int:
    """Parse the command line, run and record what is not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("task")
    add("method")
    add("seed", type=int)
    add("--primitives", default="panda-cube@champion", help="default: %(default)s")
    add("--registry", type=Path, metavar="DIR", default=Path("registry"), help="of the primitives or skills")
    add("--set", dest="settings", metavar="A.B=C", action="append", default=[], help="of the run; repeatable")
    add("--runs", type=Path, metavar="DIR", default=Path("runs"), help="of run directories (default: %(default)s)")
    add("--out", type=Path, metavar="FILE", required=True)
    given = parser.parse_args()
    if given.out.exists():
        print(f"skipped, {given.out} is there")
        return 0
    config = trial_config(given.task, given.method, given.seed, given.primitives, given.settings)
    result = run_trial(config, given.registry, given.runs / config.directory_name)
    write_json(given.out, result)
    print(f"{given.out}: {result['evaluation']['success_last']:.1%} at the last step")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
