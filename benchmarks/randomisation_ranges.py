"""What each range of randomisation costs and buys: docs/results/robust.md.

    python -m benchmarks.randomisation_ranges --json docs/results/randomisation_ranges.json

A student learns from the champion for each range of ``panda_cube_robust.yaml``, in worlds that draw that range alone;
one in worlds that draw nothing, and one in worlds that draw everything. Each is then evaluated in the nominal world,
which says what the range costs, and beside its teacher in its own worlds, which says what it buys.
"""

from __future__ import annotations

import functools
import multiprocessing
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.measuring import parser_of, run_benchmark
from benchmarks.report.robustness import ranges_table
from benchmarks.robustness import ROBUST_FILE
from service.actors.evaluation import DeterministicPolicy, evaluate_run
from service.config import Config, load_config
from service.policies.numpy_policy import numpy_bob
from service.primitives.loading import load_bob
from service.randomisation_config import RandomisationConfig

PACKAGES = ("mujoco", "torch", "numpy")
NOTHING, ALL = "nothing", "everything"


@dataclass(frozen=True, slots=True)
class Settings:
    """What is learned, and evaluated."""

    teacher: str = "panda-cube@champion"
    registry: str = "registry"
    env_steps: int = 1_000_000
    episodes: int = 1000
    seed: int = 0
    """Of each student."""
    evaluation_seed: int = 9000
    workers: int = 1


def worlds_of(drawn: RandomisationConfig) -> dict[str, RandomisationConfig]:
    """The ranges of a recipe, each alone, and none and all of them; by name."""
    given = {name: value for name, value in drawn.model_dump(exclude={"num_models"}).items() if value is not None}
    alone = {name: RandomisationConfig(num_models=drawn.num_models, **{name: value}) for name, value in given.items()}
    return {NOTHING: RandomisationConfig(), **alone, ALL: drawn}


def measure_range(name: str, settings: Settings) -> dict[str, Any]:
    """Success of a student of these worlds and of his teacher, at the last step."""
    recipe = load_config(ROBUST_FILE, [f"run.total_env_steps={settings.env_steps}", "run.evaluation_interval=0"])
    randomisation = worlds_of(recipe.world.randomisation)[name]
    config = recipe.model_copy(
        update={
            "seed": settings.seed,
            "world": recipe.world.model_copy(update={"randomisation": randomisation}),
            "run": recipe.run.model_copy(update={"num_threads": 1}),
        }
    )
    student = _learn(config, settings)
    teacher = load_bob(settings.teacher, Path(settings.registry))
    players: Mapping[str, tuple[DeterministicPolicy, Config]] = {
        "student": (student, config),
        "teacher": (teacher.policy, teacher.config),
    }
    rates = {
        f"{player}_{world}": evaluate_run(
            policy,
            seen.model_copy(update={"world": seen.world.nominal.model_copy(update={"randomisation": given})}),
            "mixed",
            settings.episodes,
            seed=settings.evaluation_seed,
            num_threads=1,
        ).as_dict()
        for player, (policy, seen) in players.items()
        for world, given in (("nominal", RandomisationConfig()), ("drawn", randomisation))
    }
    return {"ranges": randomisation.model_dump(mode="json", exclude_none=True), **rates}


def benchmark(settings: Settings) -> dict[str, Any]:
    """All students, for JSON."""
    names = list(worlds_of(load_config(ROBUST_FILE).world.randomisation))
    rows = {}
    for name, row in zip(names, _measure_all(names, settings), strict=True):
        rows[name] = row
        print(f"{name}: nominal {row['student_nominal']['success_last']:.1%}", flush=True)
    return {"rows": rows}


def _measure_all(names: list[str], settings: Settings) -> Iterator[dict[str, Any]]:
    context = multiprocessing.get_context("spawn")  # torch does not survive a fork
    with ProcessPoolExecutor(settings.workers, mp_context=context) as pool:
        yield from pool.map(functools.partial(measure_range, settings=settings), names)


def _learn(config: Config, settings: Settings) -> DeterministicPolicy:
    import torch

    from service.io.run_directory import RunDirectory
    from service.runtime.distillation_run import DistillationRun
    from service.runtime.starting import read_start

    torch.set_num_threads(1)
    start = read_start(settings.teacher, Path(settings.registry), config)
    with tempfile.TemporaryDirectory() as directory:
        run = DistillationRun(config, RunDirectory(Path(directory) / "run"), start=start)
        try:
            run.run()
            return numpy_bob(run.parameters())
        finally:
            run.close()


def main() -> int:
    """Parse the command line, measure, write and print."""
    given = parser_of(__doc__, Settings()).parse_args()
    return run_benchmark("randomisation_ranges", PACKAGES, given, Settings, benchmark, ranges_table)


if __name__ == "__main__":
    raise SystemExit(main())
