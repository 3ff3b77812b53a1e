"""Bob's success on random goals: fresh resets, no exploration noise, a fixed number of steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Protocol

import numpy as np

from service.base.intervals import wilson_interval
from service.base.progress import doing
from service.base.types import BoolArray, FloatArray, Metrics, StateArray
from service.config import Config, WorldConfig
from service.envs.batch import WorldBatch
from service.envs.observations import ACTION, bob_observation, distances
from service.envs.rules import Rules
from service.envs.sampling import GoalKind
from service.envs.task import Task

Observer = Callable[[WorldBatch, StateArray, BoolArray], None]
"""Called with the worlds, their (N, 3 K) goals, metres, and (N,) whether they are solved, at the start and after each
step."""

EVALUATION_SEED = 1_000_003
"""Evaluations during a run always use the same goals, so that they compare."""
REPORTED_SEED = EVALUATION_SEED + 1
"""Final evaluations use goals that chose nothing."""
SELECTION_SEED = EVALUATION_SEED + 2
"""The best of several runs is chosen on goals of its own: chosen on those that are reported, it would look too good."""


class DeterministicPolicy(Protocol):
    """A policy that acts without noise."""

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        """(N, O) Bob's input to actions (N, 4)."""


class IdlePolicy:
    """A policy that does nothing. It still solves the goals that happen to lie next to the object: a lower bound."""

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        """Zero actions (N, 4)."""
        return np.zeros((observation.shape[0], ACTION.size), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Success rates over ``num_episodes`` goals of one kind."""

    goals: str
    num_episodes: int
    num_steps: int
    success_last: float
    """Share that is solved at the last step: within the success distance, or as the task says."""
    success_last_low: float
    """Lower end of the 95 % Wilson interval of ``success_last``."""
    success_last_high: float
    """Upper end of that interval."""
    success_ever: float
    """Share that is solved after any step."""
    mean_distance_m: float
    """Mean distance of the objects to their goals at the last step."""

    def as_dict(self) -> dict[str, float | int | str]:
        """The rates by name, for JSON."""
        return asdict(self)


def evaluated_goals(world: WorldConfig, success_distance_m: float) -> tuple[GoalKind, ...]:
    """Kinds of goals on which a run evaluates its Bob: those that its world can have."""
    if world.fixture != "none":
        return ("table",)
    high = world.workspace.height_m > max(world.rest_heights_m) + success_distance_m
    return ("table", *(("air",) if high else ()), "mixed", *(("one",) if world.num_objects > 1 else ()))


def evaluate(
    policy: DeterministicPolicy,
    config: WorldConfig,
    task: Task | GoalKind,
    *,
    num_episodes: int,
    num_steps: int,
    success_distance_m: float,
    seed: int,
    num_threads: int = 0,
    observe: Observer | None = None,
    goal: StateArray | None = None,
) -> Evaluation:
    """Play ``num_episodes`` goals from fresh resets; nothing ends an episode early.

    ``observe`` records the episodes; it changes nothing in the result. Goals are as the task draws them, or random of a
    kind; or (N, 3 K) ``goal``, metres.
    """
    rng = np.random.default_rng(seed)
    with WorldBatch(config, num_episodes, num_threads=num_threads) as worlds:
        worlds.reset(rng)
        rules = Rules(task, worlds, success_distance_m)
        rules.place(rng)
        if goal is None:
            goal = rules.draw(rng)
        ever = last = np.zeros(num_episodes, dtype=bool)
        if observe:
            observe(worlds, goal, rules.solved(goal))
        with doing(f"evaluating on {rules.task.goal_kind} goals", num_steps * num_episodes, "env steps") as shown:
            for _ in range(num_steps):
                worlds.step(policy.act_deterministic(bob_observation(worlds.positions(), goal)))
                rules.advance(goal)
                last = rules.solved(goal)
                ever = ever | last
                if observe:
                    observe(worlds, goal, last)
                shown.advance(num_episodes)
        distance = distances(worlds.object_position, goal)
    low, high = wilson_interval(int(last.sum()), num_episodes)
    return Evaluation(
        goals=rules.task.goal_kind,
        num_episodes=num_episodes,
        num_steps=num_steps,
        success_last=float(last.mean()),
        success_last_low=low,
        success_last_high=high,
        success_ever=float(ever.mean()),
        mean_distance_m=float(distance.mean()),
    )


def evaluate_run(
    policy: DeterministicPolicy,
    config: Config,
    kind: GoalKind,
    num_episodes: int,
    *,
    seed: int,
    num_threads: int = 0,
) -> Evaluation:
    """Evaluate a policy as a run's configuration says; see ``evaluate``."""
    return evaluate(
        policy,
        config.world,
        kind,
        num_episodes=num_episodes,
        num_steps=config.run.evaluation_steps,
        success_distance_m=config.success_distance_m,
        seed=seed,
        num_threads=num_threads,
    )


def success_metrics(
    policy: DeterministicPolicy,
    config: Config,
    kinds: Sequence[GoalKind],
    num_episodes: int,
    *,
    seed: int,
    num_threads: int,
) -> Metrics:
    """Success rates on several kinds of goals in a run's world, as metrics ``evaluation/KIND_success_...``."""
    metrics = {}
    for kind in kinds:
        result = evaluate_run(policy, config, kind, num_episodes, seed=seed, num_threads=num_threads)
        metrics[f"evaluation/{kind}_success_last"] = result.success_last
        metrics[f"evaluation/{kind}_success_ever"] = result.success_ever
    return metrics
