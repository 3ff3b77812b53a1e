"""Make the small file of a run that ``docs/results`` keeps and the report is made from.

    python -m benchmarks.record_run runs/cube --out docs/results/runs/cube-0.json
    python -m benchmarks.record_run runs/lsd-0 --skills --out docs/results/skills/lsd-0.json
    python -m benchmarks.record_run panda-cube@1 --skills --registry DIRECTORY --out docs/results/skills/ours-0.json

It holds the configuration, the metrics thinned to at most 300 points, a sample of the goals in the layout of
``goals.jsonl`` and counts of all of them, and what is measured here: the newest Bob on every task (``TASKS``), and
the coverage of random compositions at three stages of training. That takes a minute or two.

With ``--skills`` it holds less: at most 100 points, and the coverage of random skills of 50 steps, an episode of the
downstream tasks. Of self-play a skill is a random composition of the primitives. Of a published version the end alone
is known.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring import machine, one_line_errors, write_json
from benchmarks.run_files import COUNTERS, FORMAT_VERSION, RANDOM, STAGES, Records, Run, blocks, thin
from service.actors.coverage import NUM_SKILLS, RandomPolicy, composition_paths, skill_paths, visited_share
from service.actors.evaluation import DeterministicPolicy, Evaluation, IdlePolicy, evaluate
from service.base.errors import TandemError
from service.base.tensors import split_parts
from service.base.types import StateArray
from service.base.version import LEARNING_VERSION
from service.config import Config, WorldConfig
from service.config.run import CELL_SIZE_M
from service.config.skills import SkillDiscoveryConfig
from service.envs.task import EPISODE_STEPS, Task
from service.envs.tasks import find_task
from service.generator.records import of_furthest
from service.media.artifacts import COVERAGE_STEPS
from service.media.figures import read_records
from service.policies.frozen_skills import FrozenSkills
from service.policies.numpy_policy import NumpyMCPPolicy, numpy_bob
from service.policies.parameters import Parameters
from service.registry.loading import Trained, load
from service.store.checkpoints import CheckpointStore, read_checkpoint
from service.store.run_directory import RunDirectory

GOAL_RECORDS, GOALS_EACH = 60, 10
"""Stages of the run of which goals are kept, and the number of goals of each."""
NUM_SLICES = 30
"""Equal parts of a run's env steps."""
BIN_M = 0.025
NUM_BINS = {"height": 13, "distance": 16}
"""The last one also holds what is beyond it."""
OURS = "ours"
"""Name of self-play among the methods of skills."""
SKILL_POINTS = 100
KEPT_OF_SKILLS = (*COUNTERS, "evaluation/coverage", "skills/", "learner/", "bob/env_steps_fraction")
"""Beginnings of the names of metrics that are kept of skills."""
NUM_EPISODES = 300
ASKED, ASKED_STEPS = 0.90, 30e6
"""Success on mixed goals at the last step, after at most so many env steps from scratch."""
SEED = 0
"""Seed of the goals; those evaluated during a run are others."""

TASKS = {
    "mixed": Task("Mixed", "anywhere in the workspace with probability 0.7, else on the table", "mixed"),
    "air": Task("Air", "more than 5 cm above an object that rests on the table", "air"),
    "table": Task("Table", "on the table", "table"),
    "larger": find_task("larger"),
    "sphere": find_task("sphere"),
}
ASKED_RATES = {"mixed": 0.95, "air": 0.95, "table": 0.95, "larger": 0.90, "sphere": 0.85}
"""Success at the last step that we ask of Bob."""
NUM_SETS = 10
KEPT_EVERY = 4
"""Steps of a path; it is drawn, not measured."""
_Player = Callable[..., StateArray]
"""Plays the random skills of a ``seed``; their paths."""


def head_of(config: Config, name: str) -> Run:
    """What every file of a run begins with; ``name`` is for tables."""
    recorded = machine() | {"learning_version": LEARNING_VERSION}
    return {
        "format_version": FORMAT_VERSION, "name": name, "recorded": recorded, "config": config.model_dump(mode="json")
    }  # fmt: skip


def record_run(directory: RunDirectory, name: str) -> Run:
    """Everything that is kept of a run without measuring anything; ``name`` is for tables."""
    config = directory.read_config()
    goals = read_records(directory.goals_file)
    return head_of(config, name) | {
        "environment": _environment(directory),
        "series": thin(read_records(directory.metrics_file)),
        "curriculum": count_goals(goals, config.world.rest_height_m),
        "goals": sample_goals(goals),
    }


def read_stages(directory: RunDirectory) -> dict[int, Parameters]:
    """Parameters of Bob, or of skills, in a run's snapshots and its newest checkpoint, by env steps, in their order.

    Raises:
        TandemError: a snapshot is damaged, or there is no usable checkpoint.
    """
    part = directory.read_config().part
    store = CheckpointStore(directory.snapshots)
    saved = [read_checkpoint(store.path(step)) for step in store.steps()]
    saved.append(CheckpointStore(directory.checkpoints).load_latest())
    stages = {int(each.meta["env_steps"]): split_parts(each.arrays)[part] for each in saved}
    return dict(sorted(stages.items()))  # a killed run may have a snapshot that is newer than its checkpoint


def measure_run(directory: RunDirectory) -> dict[str, Any]:
    """Evaluations of a run's newest Bob on every task, and the coverage at all stages."""
    config, bobs = directory.read_config(), read_stages(directory)
    newest = numpy_bob(bobs[max(bobs)])
    return {"evaluations": measure_tasks(newest, config), "coverage": measure_coverage(bobs, config)}


def record_skills(run: RunDirectory | Trained, name: str) -> Run:
    """Everything that is kept of a run of skills, or of self-play as skills; of a published version its end."""
    learned: dict[str, Any] = {}
    if isinstance(run, RunDirectory):
        config, stages = run.read_config(), read_stages(run)
        series = thin(read_records(run.metrics_file), SKILL_POINTS, KEPT_OF_SKILLS)
    elif run.manifest is None:
        raise TandemError(f"{run.label} is not published: name a run directory or NAME@ALIAS")
    else:
        env_steps = int(run.manifest.metrics["env_steps"])
        config, stages, series = run.config, {env_steps: run.parameters}, {"env_steps": [env_steps]}
        # what acts has the defaults of all other keys
        learned = {"config": dict(run.manifest.config), "primitives": run.label, "primitives_digest": run.digest}
    coverage = measure_coverage(stages, config, num_steps=EPISODE_STEPS)
    if coverage is None:
        raise TandemError(f"{name} has a monolithic Bob, who has no skills; name another run")
    return (
        head_of(config, name)
        | learned
        | {
            "method": config.skills.method if isinstance(config, SkillDiscoveryConfig) else OURS,
            "series": series,
            "coverage": coverage,
        }
    )


def count_goals(records: Records, rest_height_m: float) -> dict[str, Any]:
    """Goals and solved goals by time, by height above where the object rests, and by distance from its start.

    Args:
        records: of ``goals.jsonl``, see ``sampled_goals``.
        rest_height_m: of the object's centre on the table.

    Returns:
        For JSON: ``env_steps``, the end of the last slice of time, and of height and distance ``goals`` and ``solved``,
        for each slice a list of counts, one for each bin of 2.5 cm.
    """
    end = records[-1]["env_steps"]
    goals = of_furthest([goal for record in records for goal in record["goals"]])
    time = np.array([record["env_steps"] for record in records for _ in record["goals"]], dtype=np.float64)
    finite = np.isfinite(goals).all(axis=1)
    time, start, goal, solved = time[finite], goals[finite, :3], goals[finite, 3:6], goals[finite, 6]
    slices = np.minimum((time / end * NUM_SLICES).astype(int), NUM_SLICES - 1)
    values = {"height": goal[:, 2] - rest_height_m, "distance": np.linalg.norm(goal - start, axis=1)}
    return {"env_steps": end} | {name: _count(slices, value, solved, name) for name, value in values.items()}


def _count(slices: NDArray[np.int64], values: StateArray, solved: StateArray, name: str) -> dict[str, list[list[int]]]:
    num_bins = NUM_BINS[name]
    bins = np.clip(np.floor(values / BIN_M).astype(int), 0, num_bins - 1)  # contact lets an object rest a hair lower
    place, num_places = slices * num_bins + bins, NUM_SLICES * num_bins
    counts = {"goals": np.bincount(place, minlength=num_places), "solved": np.bincount(place, solved, num_places)}
    return {key: count.astype(int).reshape(NUM_SLICES, num_bins).tolist() for key, count in counts.items()}


def sample_goals(records: Records) -> list[dict[str, Any]]:
    """Records of ``goals.jsonl``, joined to at most 60 stages with at most 10 goals each, evenly taken."""
    kept = []
    for block in blocks(len(records), GOAL_RECORDS):
        goals = [goal for index in block for goal in records[index]["goals"]]
        chosen = sorted({round(place) for place in np.linspace(0, len(goals) - 1, GOALS_EACH)}) if goals else []
        kept.append({"env_steps": records[block[-1]]["env_steps"], "goals": [goals[index] for index in chosen]})
    return kept


def _environment(directory: RunDirectory) -> dict[str, Any]:
    """Commit and versions the run was last started with."""
    path = directory.path / "environment.json"
    environment: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return environment


def play_task(policy: DeterministicPolicy, task: Task, config: Config, num_episodes: int, seed: int) -> Evaluation:
    """A policy on one of ``tasks_in``, from fresh resets, evaluated as a run evaluates Bob."""
    return evaluate(
        policy,
        task.world_from(config.world),
        task.goal_kind,
        num_episodes=num_episodes,
        num_steps=config.run.evaluation_steps,
        success_distance_m=config.success_distance_m,
        seed=seed,
        num_threads=config.run.num_threads,
    )


def measure_tasks(bob: DeterministicPolicy, config: Config) -> list[dict[str, Any]]:
    """Bob without noise and a policy that does nothing, from fresh resets.

    Returns:
        Rows as ``tandem evaluate --json`` prints them; ``policy`` is "bob" or "idle", ``goals`` the task's name.
    """
    rows = []
    for name, task in tasks_in(config.world).items():
        for label, policy in {"bob": bob, "idle": IdlePolicy()}.items():
            result = play_task(policy, task, config, NUM_EPISODES, SEED)
            rows.append({"policy": label, **result.as_dict(), "goals": name})
    return rows


def tasks_in(world: WorldConfig) -> dict[str, Task]:
    """Those of ``TASKS`` that a world has, and of several objects one alone."""
    if world.num_objects == 1:
        return TASKS
    return {name: task for name, task in TASKS.items() if name != "sphere"} | {"one": Task("One", goals="one")}


def pick_stages(env_steps: Collection[int]) -> dict[str, int]:
    """Snapshots nearest to the stages' shares of a run; one that is nearest to several shows the last of them."""
    steps = np.sort(list(env_steps))
    nearest = {int(steps[np.abs(steps - share * steps[-1]).argmin()]): name for name, share in STAGES.items()}
    return {name: at for at, name in nearest.items()}


def measure_coverage(
    stages: Mapping[int, Parameters], config: Config, *, num_sets: int = NUM_SETS, num_steps: int = COVERAGE_STEPS
) -> dict[str, Any] | None:
    """The share of the workspace's table cells of 5 cm that each stage's random skills move the object into.

    Args:
        stages: parameters of Bob, or of skills, by env steps of training.
        config: of the run.
        num_sets: sets of 32 skills, each from a seed of its own, the same for all stages.
        num_steps: of each skill.

    Returns:
        For JSON; None for a monolithic Bob, who has nothing to compose.
    """
    common: dict[str, Any] = {"num_skills": NUM_SKILLS, "num_steps": num_steps, "num_threads": config.run.num_threads}

    def player(parameters: Parameters) -> _Player | None:
        if isinstance(config, SkillDiscoveryConfig):
            return partial(skill_paths, FrozenSkills(parameters, config.skills), config.world, **common)
        bob = numpy_bob(parameters)
        return partial(composition_paths, bob, config.world, **common) if isinstance(bob, NumpyMCPPolicy) else None

    found: dict[str, dict[str, Any]] = {
        RANDOM: _measure_sets(partial(composition_paths, RandomPolicy(), config.world, **common), config, num_sets)
    }
    for name, env_steps in pick_stages(stages).items():
        if (play := player(stages[env_steps])) is None:
            return None
        found[name] = {"env_steps": env_steps, **_measure_sets(play, config, num_sets)}
    return {"num_skills": NUM_SKILLS, "num_steps": num_steps, "cell_size_m": CELL_SIZE_M, "stages": found}


def _measure_sets(play: _Player, config: Config, num_sets: int) -> dict[str, Any]:
    sets = [play(seed=seed) for seed in range(num_sets)]
    kept = np.round(1000 * sets[0][:, ::KEPT_EVERY]).astype(int)
    return {
        "shares": [round(visited_share(paths, config.world.workspace), 4) for paths in sets],
        "paths_mm": kept.reshape(NUM_SKILLS, -1).tolist(),
    }


@one_line_errors
def main() -> int:
    """Parse the command line, read, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", metavar="RUN_DIR|NAME@ALIAS", help="the second with --skills")
    parser.add_argument("--registry", default="registry", help="of a published version (default: registry)")
    parser.add_argument("--out", type=Path, metavar="FILE", required=True, help="its stem is the run's name")
    parser.add_argument("--skills", action="store_true", help="where its random skills take the object, and less else")
    given = parser.parse_args()
    directory, name = RunDirectory(Path(given.run)), given.out.stem
    if given.skills:
        run = record_skills(directory if directory.exists else load(given.run, given.registry), name)
    else:
        run = record_run(directory, name) | measure_run(directory)
    write_json(given.out, run)
    print(f"{given.out}: {given.out.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
