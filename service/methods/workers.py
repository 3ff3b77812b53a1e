"""Two of the three workers of self-play: the rollout worker and the task generator. The third is the ``Learner``.

``LocalSelfPlay`` calls them in its own process, ``ray_actors`` puts each into a process of a Ray cluster. Arrays that
come through Ray's object store are read-only and are never written to.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.actors.evaluation import EVALUATION_SEED, success_metrics
from service.actors.rollout import Diverged, Rollout, Weights
from service.actors.self_play import Players, SelfPlay, StochasticPolicy
from service.base.types import Metrics
from service.config.self_play import SelfPlayConfig
from service.envs.sampling import GoalKind
from service.envs.scene import build_layout
from service.generator.bins import TaskBins
from service.generator.generator import NUM_STARTS, TaskGenerator
from service.generator.opponents import Opponents
from service.generator.records import GoalSummary, join_summaries, summarize
from service.generator.snapshot import GeneratorSnapshot
from service.methods.method import Iteration, goal_grid
from service.policies.numpy_policy import NumpyGaussianPolicy, numpy_bob
from service.store.models import GoalGrid


@dataclass(frozen=True, slots=True)
class RoundSummary:
    """A played round in a few numbers; its rollout travels on its own."""

    id: tuple[int, int, int]
    num_env_steps: int
    num_worlds: int
    diverged: Diverged
    play_s: float
    metrics: Metrics


class RolloutWorker:
    """Plays rounds on its own worlds.

    Consumes weights, a snapshot of the task generator and past opponents, produces a rollout and a summary of its
    goals; waits for nothing.

    Args:
        config: the run; ``game.num_worlds`` are this worker's.
        actor, incarnation: first parts of its rollouts' ids. The very first worker of a run draws from the random
            numbers of the run's seed.
        num_threads: native threads for physics; 0 for one per core.
    """

    def __init__(self, config: SelfPlayConfig, actor: int = 0, incarnation: int = 0, *, num_threads: int = 0) -> None:
        self._config, self._num_threads = config, num_threads
        source = config.seed if (actor, incarnation) == (0, 0) else [config.seed, actor, incarnation]
        self.rng = np.random.default_rng(source)
        self.game = SelfPlay(config, self.rng, actor=actor, incarnation=incarnation, num_threads=num_threads)
        self._tasks = TaskBins(config, self.game.worlds.layout)
        self._opponents_version: int | None = None
        self._past: list[tuple[StochasticPolicy, StochasticPolicy]] = []

    def play(
        self, weights: Weights, snapshot: GeneratorSnapshot, opponents: Opponents, num_rounds: int = 1
    ) -> tuple[Rollout, GoalSummary, RoundSummary]:
        """Play a round in every world.

        Args:
            weights: the policy version to act with.
            snapshot: what Bob's goals are chosen from.
            opponents: past players.
            num_rounds: rounds that make an iteration, which share the places for new goals and starts.

        Raises:
            DivergedError: a policy no longer acts in finite numbers.
        """
        start = time.perf_counter()
        config = self._config.generator
        self.game.block_grippers(float(snapshot.success_rate))
        starts = self.game.round_starts()
        # A past Bob judges the goals of Alice, and learns nothing: without her there is none.
        fraction = config.past_opponent_fraction if self._config.game.alice_plays else 0.0
        plan = opponents.plan(self.game.worlds.num_worlds, fraction, self.rng)
        rollout = self.game.play_round(self._players(weights, opponents), plan, snapshot)
        goals = summarize(
            rollout.records,
            starts,
            self.game.reached,
            self.game.cells,
            self._tasks,
            max_goals=-(-config.replay_buffer_size // num_rounds),
            max_starts=-(-NUM_STARTS // num_rounds),
            rng=self.rng,
        )
        summary = RoundSummary(
            id=rollout.id,
            num_env_steps=rollout.num_env_steps,
            num_worlds=self._config.game.num_worlds,
            diverged=rollout.diverged,
            play_s=time.perf_counter() - start,
            metrics=rollout.metrics,
        )
        return rollout, goals, summary

    def evaluate(self, weights: Weights, kinds: Sequence[GoalKind]) -> Metrics:
        """Bob's success without noise on the run's goals of some kinds, as metrics."""
        bob, episodes = numpy_bob(weights.bob_ema), self._config.run.evaluation_episodes
        return success_metrics(bob, self._config, kinds, episodes, seed=EVALUATION_SEED, num_threads=self._num_threads)

    def _players(self, weights: Weights, opponents: Opponents) -> Players:
        if opponents.version != self._opponents_version:
            pairs = zip(opponents.alice, opponents.bob, strict=True)
            self._past = [(NumpyGaussianPolicy(alice), numpy_bob(bob)) for alice, bob in pairs]
            self._opponents_version = opponents.version
        return Players(
            version=weights.version,
            alice=NumpyGaussianPolicy(weights.alice),
            bob=numpy_bob(weights.bob),
            past_alice=[alice for alice, _ in self._past],
            past_bob=[bob for _, bob in self._past],
        )


class GeneratorWorker:
    """The task generator, behind one call for an iteration.

    Consumes summaries of goals, produces snapshots to choose goals from, and past opponents; waits for nothing.

    Args:
        config: the run.
    """

    def __init__(self, config: SelfPlayConfig) -> None:
        layout = build_layout(config.world, blocked_fraction=config.game.blocked_gripper_fraction)
        self.generator = TaskGenerator(config, layout)

    def record(self, iteration: int, weights: Weights, goals: Sequence[GoalSummary]) -> Iteration:
        """Learn from what became of an iteration's goals.

        Args:
            iteration: finished ones before it.
            weights: of the players of this iteration, who may become past opponents.
            goals: of all its rounds.

        Returns:
            The task generator's metrics, and a sample of the goals.
        """
        joined = join_summaries(goals)
        metrics = self.generator.record(joined)
        self.generator.add_opponents(iteration, weights.alice, weights.bob)
        return Iteration(metrics, joined.shown)

    def grid(self, iteration: int, num_env_steps: int) -> GoalGrid:
        """The cells in which a valid goal was ever proposed, as they are after ``iteration`` iterations."""
        grid = self.generator.grid
        counts, seen = grid.counts, np.flatnonzero(grid.seen)
        return goal_grid(grid.cells, seen, counts.num_tries, counts.success_rate(), iteration, num_env_steps)
