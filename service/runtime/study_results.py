"""The end of a study: scores of its runs, the best one, and its primitives in the registry.

The best run is named by its success on goals that are used for nothing else. What is reported of it comes from other
goals, so that having been chosen does not make it look better than it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import Any

from service.actors.evaluation import EVALUATED_GOALS, REPORTED_SEED, SELECTION_SEED, Evaluation, evaluate_run
from service.config import Config
from service.envs.sampling import GoalKind
from service.io.run_directory import RunDirectory
from service.io.study_directory import StudyDirectory
from service.policies.numpy_policy import numpy_bob
from service.policies.parameters import Parameters
from service.primitives.loading import load
from service.primitives.publishing import publish_run
from service.registry.names import Version
from service.registry.registry import Registry
from service.runtime.study import RunEnd
from service.store.address import address_from_environment
from service.store.disk_reader import DiskReader, run_id_of
from service.store.errors import StoreError
from service.store.run_writer import reporting_to

SELECTION_GOALS: GoalKind = "mixed"
NUM_EPISODES = 1000
"""Goals of each kind: a success of 95 % is then known to 1.4 points either way."""


@dataclass(frozen=True, slots=True)
class Scores:
    """Bob's success at the end of one run."""

    selection: Evaluation
    """On the goals by which the best run is named."""
    reported: tuple[Evaluation, ...]
    """On other ones, of every kind."""

    def metrics(self) -> dict[str, float]:
        """The rates by metric."""
        named = {f"evaluation/{each.goals}": each for each in self.reported}
        named[f"selection/{self.selection.goals}"] = self.selection
        last = {f"{name}_success_last": each.success_last for name, each in named.items()}
        return last | {f"{name}_success_ever": each.success_ever for name, each in named.items()}

    def as_dict(self) -> dict[str, Any]:
        """The rates by name, for JSON."""
        return {
            "selection": self.selection.as_dict(),
            "reported": {each.goals: each.as_dict() for each in self.reported},
        }


def score(config: Config, parameters: Parameters) -> Scores:
    """Evaluate a Bob on the goals by which a best one is chosen, and on those that are reported.

    Args:
        config: of his run.
        parameters: his.
    """
    policy = numpy_bob(parameters)

    reported = tuple(evaluate_run(policy, config, kind, NUM_EPISODES, seed=REPORTED_SEED) for kind in EVALUATED_GOALS)
    return Scores(evaluate_run(policy, config, SELECTION_GOALS, NUM_EPISODES, seed=SELECTION_SEED), reported)


def score_run(directory: RunDirectory) -> Scores:
    """Evaluate the Bob of a run's newest checkpoint.

    Raises:
        TandemError: the run has no usable checkpoint.
    """
    trained = load(str(directory.path))
    return score(trained.config, trained.parameters)


def best_seed(scores: Mapping[int, Scores]) -> int:
    """The seed with the highest success on the selection's goals; of equals, whose object ends nearer to the goals."""
    return max(scores, key=lambda seed: (scores[seed].selection.success_last, -scores[seed].selection.mean_distance_m))


def publish_best(directory: StudyDirectory, registry: Registry, run: RunEnd, scores: Scores) -> Version | None:
    """Publish the Bob of one run of a study, whose manifest then has the seed in its configuration.

    Returns:
        The version, as ``publish_run`` does; None for a Bob without primitives.

    Raises:
        StorageError: see ``publish_run``.
    """
    place = directory.run(run.seed)
    config = place.read_config()
    if config.policy.monolithic_bob is not None:
        return None
    metrics = scores.metrics() | {"env_steps": float(run.num_env_steps)}
    version = publish_run(place, registry, config, load(str(place.path)).parameters, metrics)
    run_id = run_id_of(place.path)
    status = DiskReader(directory.path).run(run_id)
    place.claim(resume=True)
    with closing(place), suppress(StoreError):
        told = status.model_copy(update={"published": str(version), "epoch": place.epoch})
        with closing(reporting_to(place, run_id, address_from_environment())) as writer:
            writer.status(told)
    return version
