"""Learning a task: soft actor-critic composes frozen primitives, sets skills, or learns from nothing.

An iteration is an episode of every world.
"""

from __future__ import annotations

import functools
import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from pydantic import ValidationError

from service.actors.evaluation import DeterministicPolicy, Evaluation
from service.base.errors import ConfigError, TandemError
from service.base.types import FloatArray, Metrics
from service.base.user_code import recorded
from service.config.distillation import DistillingConfig
from service.config.frozen import first_error
from service.config.run import SUCCESS_DISTANCE_M
from service.config.self_play import MCPConfig, SelfPlayConfig
from service.config.task import TaskConfig
from service.config.task_methods import TaskMethod, find_method
from service.config.world import WorldConfig
from service.envs.gym.vector import TabletopVectorEnv
from service.envs.observations import layouts
from service.envs.task import Task
from service.envs.tasks import find_task
from service.learner.off_policy import OffPolicyLoop
from service.learner.replay import ReplayBuffer
from service.learner.sac import Batch, SACLearner
from service.learner.sac_networks import GaussianActor, MCPActor
from service.methods.compose import ComposePrimitivesVector
from service.methods.method import Iteration, Method, State
from service.methods.task_check import check_fits, check_task
from service.methods.task_evaluation import CURVE_SEED, FINAL_SEED, evaluate_on, numbers_of
from service.methods.task_worlds import SkillTaskWorlds, TaskWorlds, columns
from service.policies.learned_policy import RESIDUAL, learner_inputs, num_inputs
from service.policies.parameters import Parameters
from service.registry.loading import Trained, learned_policy, load

_RELABELLED_UNTIL = 0.5
"""Progress from which on the share of relabelled goals is its last one (docs/results/log.md, T17)."""
_logger = logging.getLogger(__name__)


class TaskLearning(Method):
    """A learner in the worlds of one task.

    Args:
        config: the run.
        acts_with: primitives or skills of which the method makes use, and whose world it plays in.

    Raises:
        TandemError: these do not fit the method, or are not those that the run began with.
    """

    def __init__(self, config: TaskConfig, acts_with: Trained) -> None:
        super().__init__()
        self._how = find_method(config.method)
        check_fits(self._how, acts_with)
        if config.primitives_digest not in (None, acts_with.digest):
            raise TandemError(
                f"{acts_with.label} has other parameters than the {config.primitives} that this run began with: name "
                "the registry that has those with --registry, or their new place with --set primitives=PATH"
            )
        self.config, self._acts_with = config, acts_with
        self._task = find_task(config.task, config.code, config.task_world)
        torch.set_num_threads(config.run.num_threads or 1)
        self._worlds = self._make_worlds()
        self.loop = make_loop(config, self._how, acts_with, self._worlds)
        """Collects transitions and learns from them."""

    def step(self) -> Iteration:
        """Play an episode in every world, with its updates."""
        before, total = self.num_env_steps, self.config.run.total_env_steps
        assert isinstance(self.loop.make_batch, Hindsight)
        self.loop.make_batch.set_progress(before / total)
        with self.timing("play and learn"):
            learned = self.loop.play(min(self._task.episode_steps * self._worlds.num_worlds, total - before))
        metrics = self.count(self.loop.num_env_steps - before) | self._episodes()
        metrics |= {f"learner/{name}": value for name, value in learned.items()}
        metrics["learner/num_updates"] = self.loop.num_updates
        return Iteration(metrics)

    def evaluate(self) -> Metrics:
        """Success without noise on goals that are not learned on."""
        found = self._evaluate(self.config.run.evaluation_episodes, CURVE_SEED)
        return {"evaluation/success_last": found.success_last, "evaluation/success_ever": found.success_ever}

    def measure(self) -> Metrics:
        """Success without noise on the goals that all methods are compared on, with 95 % intervals."""
        found = self._evaluate(self.config.run.final_episodes, FINAL_SEED)
        return {f"evaluation/{name}": value for name, value in numbers_of(found).items()}

    def parameters(self) -> Parameters:
        """The learner's actor, averaged."""
        return self.loop.learner.averaged_parameters()

    def player(self) -> DeterministicPolicy:
        """The policy learned so far, at the start of new episodes."""
        acts_with, config = self._acts_with if self._how.takes else None, self._acts_with.config
        return learned_policy(self.parameters(), acts_with, config)

    def close(self) -> None:
        """Stop the worlds' threads; a second call does nothing."""
        self._worlds.close()

    def state(self) -> State:
        """The off-policy loop with its replay buffer, and the actor for readers without torch."""
        arrays, values = self.loop.state()
        return {"loop": arrays, "policy": dict(self.parameters()), "random": values}

    def load_state(self, state: State) -> None:
        """Continue, bit for bit, where ``state`` gave these."""
        self.loop.load_state(state["loop"], state["random"])

    def _evaluate(self, num_episodes: int, seed: int) -> Evaluation:
        config = self.config
        return evaluate_on(
            self._task, config.world, self.player(), num_episodes, config.seed + seed, config.run.num_threads
        )

    def _episodes(self) -> Metrics:
        """Means over the episodes that ended in this iteration, which were played with noise."""
        finished = np.array(self._worlds.finished, dtype=float).reshape(-1, 2)
        self._worlds.finished.clear()
        if not len(finished):
            return {}
        total, last = finished.T
        means = {"return": total.mean(), "success_last": last.mean()}
        if self._task.reward is None:  # or else what is paid says nothing of it
            means["success_ever"] = (total > 0.0).mean()
        return {f"rollout/{name}": float(value) for name, value in means.items()}

    def _make_worlds(self) -> TaskWorlds:
        """The worlds that the learner acts in: by itself, by weights of primitives, or by skills."""
        config, acts_with, seed = self.config, self._acts_with, spread_seed(self.config.seed, 3)
        env: VectorEnv[Any, Any, Any] = TabletopVectorEnv(
            config.sac.num_worlds,
            config.world,
            task=self._task,
            success_distance_m=SUCCESS_DISTANCE_M - config.reward_margin_m,
            num_threads=config.run.num_threads,
        )
        if self._how.takes == "skills":
            return SkillTaskWorlds(env, seed, acts_with.skills)
        if self._how.composes:
            env = ComposePrimitivesVector(env, acts_with, residual=RESIDUAL if self._how.adds_action else 0.0)
        return TaskWorlds(env, seed, layouts(acts_with.config.world))


class Hindsight:
    """Makes batches in which a share of the goals are places where the object came to later in the same episode.

    Args:
        worlds: whose rewards are paid.
        ratio: see ``TaskMethod.her_ratio``.
    """

    def __init__(self, worlds: TaskWorlds, ratio: tuple[float, float] | None) -> None:
        self._worlds, (self._first, self._last) = worlds, ratio or (0.0, 0.0)
        self.share = self._first
        """Of the transitions, on average (HER, ``future``)."""

    def set_progress(self, progress: float) -> None:
        """Set the share for a progress from 0, when learning begins, to 1, when it ends."""
        self.share = self._first + (self._last - self._first) * min(1.0, progress / _RELABELLED_UNTIL)

    def __call__(self, replay: ReplayBuffer, size: int, rng: np.random.Generator) -> Batch:
        """Draw ``size`` transitions and relabel some of them."""
        places = replay.draw(size, rng)
        rows = replay.read(places)
        if self.share:
            other = rng.random(size) < self.share
            seen = self._worlds.seen
            later = replay.draw_later(places, rng)
            if "view" in rows:  # a reward of a user's sees where objects are, not where they are seen
                goal = replay.column("view", later)[:, : 3 * seen.num_objects]
            else:
                goal = replay.column("following", later)[:, seen.positions["object"]]
            if seen.num_objects > 1:
                goal = _mixed(goal, rows["goal"], rng)
            rows["goal"][other] = goal[other]
            relabelled = {name: values[other] for name, values in rows.items()}
            rows["reward"][other, 0] = self._worlds.rewards(relabelled, goal[other])
        return Batch(
            learner_inputs(rows["previous"], rows["positions"], rows["goal"], self._worlds.seen),
            rows["action"],
            rows["reward"][:, 0],
            learner_inputs(rows["positions"], rows["following"], rows["goal"], self._worlds.seen),
        )


def _mixed(achieved: FloatArray, asked: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(B, 3 K) goals of which each object has its place of achieved or of asked ones; one at least is achieved."""
    size, num_objects = len(achieved), achieved.shape[1] // 3
    taken = rng.random((size, num_objects)) < 0.5
    taken[np.arange(size), rng.integers(num_objects, size=size)] = True
    return np.where(np.repeat(taken, 3, axis=1), achieved, asked)


def make_loop(config: TaskConfig, method: TaskMethod, trained: Trained, worlds: TaskWorlds) -> OffPolicyLoop:
    """Make a new learner in worlds that have begun; ``loop.make_batch`` is its ``Hindsight``."""
    size, sac = worlds.num_actions, config.sac
    num_without_goal, num_seen = num_inputs(worlds.seen)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(spread_seed(config.seed, 0))
        actor = (
            MCPActor(num_without_goal, num_seen, size, _sizes_of(trained))
            if method.mcp_actor
            else GaussianActor(num_seen, size, sac.hidden_sizes)
        )
    learner = SACLearner(actor, num_seen, size, sac, spread_seed(config.seed, 1))
    num_steps = -(-config.run.total_env_steps // sac.num_worlds)  # everything is kept
    own = worlds.env.unwrapped.rules.task.is_own
    replay = ReplayBuffer(num_steps, sac.num_worlds, {**columns(worlds.seen, view=own), "action": size})
    return OffPolicyLoop(worlds, replay, learner, Hindsight(worlds, method.her_ratio), spread_seed(config.seed, 2))


def _sizes_of(trained: Trained) -> MCPConfig:
    """Sizes of primitives and gate that are learned from nothing: those of the primitives that were named."""
    if not isinstance(trained.config, SelfPlayConfig | DistillingConfig):
        raise TandemError(f"{trained.label} has no primitives, whose sizes scratch-mcp takes: name some")
    return trained.config.policy.bob


@functools.cache
def spread_seed(seed: int, purpose: int) -> int:
    """A seed far from those of other trials: world i gets it plus i, so neighbours would share nearly all episodes."""
    return int(np.random.SeedSequence((seed, purpose)).generate_state(1)[0]) >> 1


def begin(config: TaskConfig, registry: Path | str, start_from: Trained | None) -> TaskConfig:
    """The configuration with the exact version of the primitives, their world, and the text of a task of a user's.

    Raises:
        TandemError: no such task or primitives; they are not for this method; or a task of a user's that does not run.
    """
    if start_from is not None:
        raise ConfigError("--from is for self-play and distillation; name primitives by --set primitives=NAME")
    found, how = load(config.primitives, registry), find_method(config.method)
    if config.world not in (WorldConfig(), found.config.world):
        raise ConfigError("world: a task is learned in the world of its primitives; leave out world")
    check_fits(how, found)
    task = find_task(config.task, config.code, config.task_world)
    found.playing(task)  # is refused where it has not as many objects
    if (num := found.config.world.num_objects) > 1 and not task.world.keys() & {"object", "objects"}:
        _logger.info("%s is played with %d objects, as %s knows them", task.title, num, found.label)
    check_task(task, found.config.world, relabels=how.her_ratio is not None)
    exact = config.model_copy(
        update={
            "world": found.config.world,
            "primitives": found.reference,
            "primitives_digest": config.primitives_digest or (None if how.takes is None else found.digest),
            "task_version": task.version,
            "episode_steps": task.episode_steps,
            "task_world": _as_read(task, found.config.world) if task.code else None,
            "code": recorded(config.task, config.code),
        }
    )
    for key in ("episode_steps", "task_version", "task_world"):
        if key in config.model_fields_set and getattr(config, key) != (said := getattr(exact, key)):
            raise ConfigError(f"{key} = {getattr(config, key)!r}: the task {config.task} says {said!r}; leave it out")
    if task.code:  # another length of an episode, with which settings may not go
        try:
            TaskConfig.model_validate(exact.model_dump(mode="json"))
        except ValidationError as error:
            raise ConfigError(f"{config.task}: {first_error(error)}") from None
    return exact


def _as_read(task: Task, world: WorldConfig) -> dict[str, Any] | None:
    """The settings of a task's world with the whole names of files, and what is read from them: they may change."""
    read = task.world_from(world).model_dump(mode="json")
    return {key: read[key] for key in task.world} or None


def make(config: TaskConfig, registry: Path | str, start_from: Trained | None) -> TaskLearning:
    """Make the learner, with the primitives that the run began with."""
    return TaskLearning(config, load(config.primitives, registry))
