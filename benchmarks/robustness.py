"""Policies in worlds that differ from those of training, one thing at a time: docs/results/robust.md.

    python -m benchmarks.robustness --json docs/results/robustness.json

It also measures what drawing all of it costs: env steps per CPU second of random arms, with and without, in turn.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measuring import ROOT, measure_in_turn, parser_of, ratio, run_benchmark
from benchmarks.report.robustness import robustness_table
from service.actors.evaluation import evaluate_run
from service.config import load_config
from service.envs.batch import WorldBatch
from service.primitives.loading import load_bob
from service.randomisation_config import RandomisationConfig
from service.world_config import WorldConfig

PACKAGES = ("mujoco", "numpy")
ROBUST_FILE = ROOT / "configs" / "pretrain" / "panda_cube_robust.yaml"
CASES: Mapping[str, dict[str, Any]] = {
    "the nominal world": {},
    "commands one step (40 ms) late": {"delay_steps": (1, 1)},
    "two steps late": {"delay_steps": (2, 2)},
    "object noise 5 mm": {"object_noise_m": (0.005, 0.005)},
    "object noise 10 mm": {"object_noise_m": (0.01, 0.01)},
    "object seen 1 cm off": {"object_offset_m": (0.01, 0.01)},
    "object seen 2 cm off": {"object_offset_m": (0.02, 0.02)},
    "one step late, 5 mm, 1 cm, together": {
        "delay_steps": (1, 1),
        "object_noise_m": (0.005, 0.005),
        "object_offset_m": (0.01, 0.01),
    },
    "damping x 0.45 (an arm that covers 95 % of a step)": {"damping": (0.45, 0.45)},
    "damping x 1.6 (42 %)": {"damping": (1.6, 1.6)},
    "object x 0.8": {"object_size": (0.8, 0.8)},
    "object x 1.2": {"object_size": (1.2, 1.2)},
    "object of 1 kg": {"object_mass_kg": (1.0, 1.0)},
    "friction 0.25": {"friction": (0.25, 0.25)},
    "table 1 cm higher": {"table_height_m": (0.01, 0.01)},
    "table 1 cm lower": {"table_height_m": (-0.01, -0.01)},
}
"""What differs from the nominal world, by row."""
ALL = "everything drawn, as in the recipe"


@dataclass(frozen=True, slots=True)
class Settings:
    """What is evaluated."""

    policies: str = "panda-cube@champion,panda-cube-robust@champion"
    """References, with commas."""
    registry: str = "registry"
    episodes: int = 500
    seed: int = 9000
    """Of goals, starts and what is drawn; none that anything was chosen by."""
    num_pairs: int = 9
    seconds: float = 1.0


def benchmark(settings: Settings) -> dict[str, Any]:
    """Success of every policy in every world, for JSON."""
    drawn = load_config(ROBUST_FILE).world.randomisation
    rows: dict[str, dict[str, Any]] = {}
    for reference in settings.policies.split(","):
        trained = load_bob(reference, Path(settings.registry))
        nominal = trained.config.world.nominal
        worlds = {name: RandomisationConfig(num_models=1, **case) for name, case in CASES.items()} | {ALL: drawn}
        for name, randomisation in worlds.items():
            world = nominal.model_copy(update={"randomisation": randomisation})
            config = trained.config.model_copy(update={"world": world})
            found = evaluate_run(
                trained.policy, config, "mixed", settings.episodes, seed=settings.seed, num_threads=1
            ).as_dict()
            rows.setdefault(name, {})[reference] = found
            print(f"{reference}, {name}: {found['success_last']:.1%}", flush=True)
    return {"rows": rows, "cost": _cost(load_config(ROBUST_FILE).world, settings)}


def _cost(world: WorldConfig, settings: Settings) -> dict[str, Any]:
    """Speed of worlds that draw everything, over that of the nominal one."""
    rng = np.random.default_rng(0)
    with WorldBatch(world, 120, num_threads=1) as drawn, WorldBatch(world.nominal, 120, num_threads=1) as nominal:

        def play(worlds: WorldBatch) -> int:
            worlds.reset(rng)
            for _ in range(20):
                worlds.positions()
                worlds.step(rng.uniform(-1.0, 1.0, (120, 4)).astype(np.float32))
            return 20 * 120

        plays = {"drawn": lambda: play(drawn), "nominal": lambda: play(nominal)}
        samples = measure_in_turn(plays, settings.num_pairs, settings.seconds)
    return ratio(samples["drawn"], samples["nominal"])


def main() -> int:
    """Parse the command line, measure, write and print."""
    given = parser_of(__doc__, Settings()).parse_args()
    return run_benchmark("robustness", PACKAGES, given, Settings, benchmark, robustness_table)


if __name__ == "__main__":
    raise SystemExit(main())
