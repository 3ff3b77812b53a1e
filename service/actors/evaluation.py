"""Bob's success on random goals: fresh resets, no exploration noise, a fixed number of steps."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from service.actors.self_play import Observer
from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.goals import GoalKind, draw_goals
from service.envs.observations import ACTION_SIZE, bob_observation

FloatArray = NDArray[np.float32]
StateArray = NDArray[np.float64]


class DeterministicPolicy(Protocol):
    """A policy that acts without noise."""

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        """(N, 14) Bob's input to actions (N, 4)."""


class IdlePolicy:
    """A policy that does nothing. It still solves the goals that happen to lie next to the object: a lower bound."""

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        """Zero actions (N, 4)."""
        return np.zeros((observation.shape[0], ACTION_SIZE), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class Episodes:
    """N episodes of T steps; nothing ends one early."""

    goal: StateArray
    """(N, 3) metres."""
    distance_m: StateArray
    """(T + 1, N) from object to goal, at the start and after each step."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Success rates over ``num_episodes`` goals of one kind."""

    goals: str
    num_episodes: int
    num_steps: int
    success_last: float
    """Within the success distance at the last step."""
    success_last_low: float
    """Lower end of the 95 % Wilson interval of ``success_last``."""
    success_last_high: float
    """Upper end."""
    success_ever: float
    """Within the success distance after any step."""
    mean_distance_m: float
    """Distance to the goal at the last step."""

    def as_dict(self) -> dict[str, float | int | str]:
        """The rates by name, for JSON."""
        return asdict(self)


def evaluate(
    policy: DeterministicPolicy,
    config: WorldConfig,
    kind: GoalKind,
    *,
    num_episodes: int,
    num_steps: int,
    success_distance_m: float,
    seed: int,
    num_threads: int = 0,
) -> Evaluation:
    """Play episodes on random goals (``play_episodes``) and count the successes."""
    episodes = play_episodes(
        policy,
        config,
        kind,
        num_episodes=num_episodes,
        num_steps=num_steps,
        success_distance_m=success_distance_m,
        seed=seed,
        num_threads=num_threads,
    )
    reached = episodes.distance_m[1:] <= success_distance_m
    low, high = wilson_interval(int(reached[-1].sum()), num_episodes)
    return Evaluation(
        goals=kind,
        num_episodes=num_episodes,
        num_steps=num_steps,
        success_last=float(reached[-1].mean()),
        success_last_low=low,
        success_last_high=high,
        success_ever=float(reached.any(axis=0).mean()),
        mean_distance_m=float(episodes.distance_m[-1].mean()),
    )


def play_episodes(
    policy: DeterministicPolicy,
    config: WorldConfig,
    kind: GoalKind,
    *,
    num_episodes: int,
    num_steps: int,
    success_distance_m: float,
    seed: int,
    num_threads: int = 0,
    observe: Observer | None = None,
) -> Episodes:
    """Play one episode in each of ``num_episodes`` fresh worlds, on random goals.

    Args:
        policy: Bob.
        config: the worlds.
        kind: where goals are.
        num_episodes: N.
        num_steps: T, at least 1.
        success_distance_m: ``air`` goals are further than this above an object that rests on the table.
        seed: of starts and goals.
        num_threads: native threads for physics; 0 for one per core.
        observe: records the states; it changes nothing in the result.
    """
    rng = np.random.default_rng(seed)
    distance_m = np.empty((num_steps + 1, num_episodes))
    with WorldBatch(config, num_episodes, num_threads=num_threads) as worlds:
        worlds.reset(rng)
        start, box = worlds.object_position, worlds.box_place
        goal = draw_goals(kind, rng, config, success_distance_m, start=start, box=box)
        for step in range(num_steps + 1):
            if step > 0:
                worlds.step(policy.act_deterministic(bob_observation(worlds.positions(), goal)))
            distance_m[step] = np.linalg.norm(worlds.object_position - goal, axis=1)
            if observe:
                observe(worlds.states)
    return Episodes(goal, distance_m)


def wilson_interval(successes: int, num: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson score interval of a proportion (Wilson 1927); z = 1.96 gives 95 %."""
    share = successes / num
    centre = (share + z * z / (2 * num)) / (1 + z * z / num)
    half = z * np.sqrt(share * (1 - share) / num + z * z / (4 * num * num)) / (1 + z * z / num)
    return float(max(centre - half, 0.0)), float(min(centre + half, 1.0))
