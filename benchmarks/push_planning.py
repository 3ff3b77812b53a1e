"""Lower bound of what primitives can do on *Push*: the share of goals that a planned sequence of compositions reaches.

    python -m benchmarks.push_planning panda-cube@champion --json docs/results/push_planning.json

The weights of a whole episode are searched for by the cross-entropy method (Rubinstein 1999) in the simulator itself,
for each start and goal, and held for several steps. Where an orchestrator, which sees positions and no simulator, does
worse than plans, the primitives are not what limits it. The other way round says little: a search may miss what is
there, and an orchestrator sets other weights at every step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.measuring import of_each, run_benchmark
from service.actors.evaluation import wilson_interval
from service.config.run import SUCCESS_DISTANCE_M
from service.envs.batch import WorldBatch
from service.envs.sampling import Places, draw_goals
from service.envs.task import EPISODE_STEPS
from service.envs.tasks import find_task
from service.methods.compose import check_primitives
from service.registry.learned import compose_actions

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from service.policies.numpy_policy import NumpyMCPPolicy
    from service.registry.loading import Trained

_HELD_STEPS = 5
"""Env steps that weights are held in a plan."""
_MARGIN_M = 0.01
"""A plan is done this much inside the distance that counts."""
_REACH_WEIGHT = 0.2
"""Cost of a metre between gripper and object, beside one between object and goal: it leads to the first touch."""
_LEAST_STD = 0.1


@dataclass(frozen=True, slots=True)
class Settings:
    """What is measured, and how much of it."""

    primitives: tuple[str, ...]
    """``NAME@ALIAS``, or run directories."""
    registry: str = "registry"
    task: str = "push"
    num_goals: int = 300
    num_plans: int = 48
    """Plans of one goal in each round of the search."""
    num_elites: int = 8
    num_rounds: int = 16
    goals_at_once: int = 10
    seed: int = 0
    num_threads: int = 1


class _Search:
    """Cross-entropy search for G goals at once, P plans each."""

    def __init__(self, worlds: WorldBatch, primitives: NumpyMCPPolicy, settings: Settings) -> None:
        self.worlds, self.primitives, self.settings = worlds, primitives, settings

    def distances(self, rng: np.random.Generator, goal_kind: Any) -> NDArray[np.float64]:
        """(G,) metres from object to goal after the last step of the best plan found."""
        num, plans = self.settings.goals_at_once, self.settings.num_plans
        config = self.worlds.config
        starts = self.worlds.draw_starts(rng, num)
        start = starts[:, self.worlds.layout["object"]]
        places = Places(start, self.worlds.box_place, np.empty((num, 0, 3)))
        goals = draw_goals(goal_kind, rng, config, SUCCESS_DISTANCE_M, places)
        shape = (num, EPISODE_STEPS // _HELD_STEPS, self.primitives.num_primitives)
        mean, std = np.zeros(shape), np.ones(shape)
        best = np.full(num, np.inf)
        for _ in range(self.settings.num_rounds):
            drawn = rng.standard_normal((num, plans, *shape[1:])) * std[:, None] + mean[:, None]
            drawn = np.clip(drawn, -1.0, 1.0)
            last, cost = self._play(np.repeat(starts, plans, axis=0), np.repeat(goals, plans, axis=0), drawn)
            best = np.minimum(best, last.min(axis=1))
            if (best <= SUCCESS_DISTANCE_M - _MARGIN_M).all():
                break
            elites = np.argsort(cost, axis=1)[:, : self.settings.num_elites]
            chosen = np.take_along_axis(drawn, elites[:, :, None, None], axis=1)
            mean, std = chosen.mean(axis=1), np.maximum(chosen.std(axis=1), _LEAST_STD)
        return best

    def _play(
        self, starts: NDArray[np.float64], goals: NDArray[np.float64], plans: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(G, P) metres after the last step, and (G, P) costs, of (G, P, segments, K) plans."""
        self.worlds.restore(starts)
        weights = plans.reshape(len(starts), *plans.shape[2:]).astype(np.float32)
        cost, distance = np.zeros(len(starts)), np.zeros(len(starts))
        for step in range(EPISODE_STEPS):
            actions = compose_actions(self.primitives, self.worlds.positions(), weights[:, step // _HELD_STEPS], 0.0)
            self.worlds.step(np.clip(actions, -1.0, 1.0))
            distance = np.linalg.norm(self.worlds.object_position - goals, axis=1)
            reach = np.linalg.norm(self.worlds.ee_position - self.worlds.object_position, axis=1)
            cost += (distance + _REACH_WEIGHT * reach) / EPISODE_STEPS
        return distance.reshape(plans.shape[:2]), (cost + distance).reshape(plans.shape[:2])


def measure(trained: Trained, settings: Settings) -> dict[str, Any]:
    """Share of the goals of a task that plans reach at the last step."""
    task, primitives = find_task(settings.task), check_primitives(trained)
    rng = np.random.default_rng(settings.seed)
    found: list[float] = []
    num_worlds = settings.goals_at_once * settings.num_plans
    with WorldBatch(task.world_from(trained.config.world), num_worlds, num_threads=settings.num_threads) as worlds:
        search = _Search(worlds, primitives, settings)
        while len(found) < settings.num_goals:
            found += search.distances(rng, task.goals).tolist()
    reached = int((np.array(found[: settings.num_goals]) <= SUCCESS_DISTANCE_M).sum())
    low, high = wilson_interval(reached, settings.num_goals)
    return {"reached": reached / settings.num_goals, "low": low, "high": high}


def benchmark(settings: Settings) -> dict[str, Any]:
    """Measure each of the primitives."""
    return {"rows": of_each(settings.primitives, settings.registry, lambda trained: measure(trained, settings))}


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    settings = result["settings"]
    return "\n".join(
        f"{name}: plans reach {row['reached']:.1%} [{row['low']:.1%}, {row['high']:.1%}] of {settings['num_goals']} "
        f"goals of {settings['task']}"
        for name, row in result["rows"].items()
    )


if __name__ == "__main__":
    raise SystemExit(run_benchmark("push_planning", __doc__, Settings, benchmark, report))
