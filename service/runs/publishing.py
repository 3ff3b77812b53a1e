"""Publishing what a run has learned until now, also where it has not ended."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from service.base.types import Metrics
from service.config import Config
from service.config.skills import SkillDiscoveryConfig
from service.config.task import TaskConfig
from service.methods.task_evaluation import FINAL_SEED, evaluate_on, numbers_of
from service.registry.loading import Trained, load
from service.registry.names import Version, check_name
from service.registry.publishing import check_publishable, measure_bob, measure_skills, publish_run
from service.registry.registry import Registry
from service.store.checkpoints import CheckpointStore
from service.store.run_directory import RunDirectory


def publish_learned(
    path: Path, registry: Path | str, name: str | None = None, primitives: str | None = None
) -> Version:
    """Publish what the newest checkpoint of a run holds, measured on the goals of the end of a run.

    Args:
        path: of the run, which no process may be running.
        registry: directory to publish in.
        name: of what is published; None: the run's.
        primitives: published version that a policy of a task acts with, if that has another name than in its run.

    Returns:
        The new version, or the newest one of that name where it has the same parameters already.

    Raises:
        TandemError: no run, one that goes on, or what it has learned cannot be published; nothing was written.
    """
    directory = RunDirectory(path)
    config = directory.read_config()
    changed = {"name": check_name(name or config.name)}
    directory.claim(resume=True)
    with closing(directory):
        learned = load(str(path.absolute()), registry, primitives)
        if learned.trained is not None:
            changed["primitives"] = learned.trained.reference
        config = config.model_copy(update=changed)
        check_publishable(config, registry)
        saved = CheckpointStore(directory.checkpoints, keep=1).load_latest()
        metrics = _measure(config, learned) | {"env_steps": saved.meta["env_steps"]}
        return publish_run(directory, Registry(Path(registry)), config, learned.parameters, metrics)


def _measure(config: Config, learned: Trained) -> Metrics:
    """What the method of the run measures at its end."""
    if isinstance(config, SkillDiscoveryConfig):
        return measure_skills(config, learned.parameters)
    if isinstance(config, TaskConfig):
        seed, run = config.seed + FINAL_SEED, config.run
        player = learned.player()
        found = evaluate_on(config.task, config.world, player, run.final_episodes, seed, run.num_threads)
        return {f"evaluation/{key}": value for key, value in numbers_of(found).items()}
    return measure_bob(config, learned.parameters)
