"""Robots by description: do they pick, how fast are they, and what does self-play make of them?

    pip install --no-deps gym-aloha dm-control robosuite
    python -m benchmarks.robots --run viperx=runs/viperx --run jaco=runs/jaco --json docs/results/robots.json

Each of ``configs/robots`` picks a cube up, carries it to a random place in the air and holds it there for 5 s, by a
hand-written policy. Env steps are of random actions with one thread, in turn with the Panda's. A run is one of
``tandem pretrain`` with that robot. Robots whose models are not installed are left out. What the recorded file has of
them stays: the Panda with other objects was measured by this program of 82ca6fd.
"""

from __future__ import annotations

import importlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.env_throughput import BatchContender
from benchmarks.measuring import RECIPE_FILE, ROOT, measure_in_turn, ratio, run_benchmark
from service.base.errors import ConfigError
from service.base.jsonl import read_jsonl
from service.config import Config, WorldConfig, load_config
from service.envs.batch import WorldBatch
from service.store.run_directory import RunDirectory

ROBOTS, RECORDED = ROOT / "configs" / "robots", ROOT / "docs" / "results" / "robots.json"
OVERRIDES = {"viperx": ("world.workspace.height_m=0.25",), "jaco": ("world.workspace.height_m=0.25",)}
"""What these arms need of a world: they do not reach the upper corners of the usual one."""
NUM_WORLDS = (8, 240)
WITHIN_M, SLIP_M = 0.01, 0.005
LAST_STEPS = 200_000
"""Env steps at the end of a run over which its shares are means."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What is measured, and how much of it."""

    run: tuple[str, ...] = ()
    """``NAME=DIR``, runs with that robot."""
    num_picks: int = 100
    num_pairs: int = 5
    seconds: float = 2.0
    """Length of each measurement of speed."""


def measure_robot(name: str, settings: Settings) -> dict[str, Any]:
    """Picks and speed of one robot."""
    world = world_of(name)
    picks = count_picks(world, settings.num_picks)
    with WorldBatch(world, 1) as worlds:
        num_joints = worlds.robot.num_joints + worlds.robot.num_fingers
    panda = load_config(RECIPE_FILE, OVERRIDES.get(name, ())).world
    speeds = {}
    for num in NUM_WORLDS:
        plays = {each: BatchContender(config, num).episode for each, config in ((name, world), ("panda", panda))}
        samples = measure_in_turn(plays, settings.num_pairs, settings.seconds)
        speeds[str(num)] = ratio(samples[name], samples["panda"])
    return {"num_joints": num_joints, "picks": picks, "speed_to_panda": speeds}


def count_picks(world: WorldConfig, num: int) -> dict[str, int]:
    """How many objects of a world a hand-written policy picks up, carries and holds."""
    placement = importlib.import_module("tests.envs.scripted").place_in_air(world, num, seed=0)
    arrived, stayed = (each < WITHIN_M for each in (placement.distance_m, placement.distance_after_hold_m))
    return {"num": num, "held": int((arrived & stayed & (placement.slip_m <= SLIP_M)).sum())}


def summarise_run(path: Path) -> dict[str, Any]:
    """The end of a run: means over its last env steps, and what its Bob was measured on."""
    directory = RunDirectory(path)
    config: Config = directory.read_config()
    records = read_jsonl(directory.metrics_file)
    last = [each for each in records if each["env_steps"] > records[-1]["env_steps"] - LAST_STEPS]
    return {
        "env_steps": records[-1]["env_steps"],
        "seed": config.seed,
        "valid_fraction": float(np.mean([each["alice/valid_fraction"] for each in last])),
        "lifted_fraction": float(np.mean([each["alice/lifted_fraction"] for each in last])),
        "success_rate": float(np.mean([each["bob/success_rate"] for each in last])),
        "object": config.world.shape.shape,
    }


def world_of(name: str) -> WorldConfig:
    """The world of the recipe with another robot."""
    return load_config(RECIPE_FILE, [f"world.robot={ROBOTS / name}.yaml", *OVERRIDES.get(name, ())]).world


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    return json.dumps(result["robots"], indent=1)


def benchmark(settings: Settings) -> dict[str, Any]:
    """Measure every robot whose model is there, and summarise the runs; what was recorded of others stays."""
    robots: dict[str, dict[str, Any]] = json.loads(RECORDED.read_text())["robots"]
    for path in sorted(ROBOTS.glob("*.yaml")):
        try:
            world_of(path.stem)
        except ConfigError as error:
            print(f"without {path.stem}: {error}", flush=True)
            continue
        robots.setdefault(path.stem, {}).update(measure_robot(path.stem, settings))
    for run in settings.run:
        name, _, directory = run.partition("=")
        robots.setdefault(name, {})["run"] = summarise_run(Path(directory))
    return {"robots": robots}


if __name__ == "__main__":
    raise SystemExit(run_benchmark("robots", __doc__, Settings, benchmark, report))
