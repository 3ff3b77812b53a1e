"""The three workers of a run: the rollout worker, the learner and the task generator.

Both runners use them: ``local`` calls them in its own process, ``ray_actors`` puts each into a process of a Ray
cluster. Arrays that come through Ray's object store are read-only and are never written to.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from service.actors.evaluation import EVALUATION_SEED, success_metrics
from service.actors.rollout import Diverged, Rollout
from service.actors.self_play import Players, SelfPlay, StochasticPolicy
from service.config import Config
from service.envs.sampling import GoalKind
from service.envs.scene import build_layout
from service.generator.generator import GoalChoice, TaskGenerator
from service.generator.opponents import OpponentPool, RoundPlan
from service.generator.records import GoalRecords, join_records, sampled_goals
from service.policies.numpy_policy import NumpyGaussianPolicy, numpy_bob
from service.store.models import GoalCell, GoalGrid
from service.types import Arrays, IntArray, Metrics, StateArray

if TYPE_CHECKING:
    from service.learner.group import Group
    from service.learner.weights import Weights

RolloutId = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Assignment:
    """The opponents and the random numbers of a round."""

    plan: RoundPlan
    rng: np.random.Generator
    """The actor's, advanced by the plan."""
    pool_version: int
    pool: OpponentPool | None
    """Past opponents; None where the actor has this version of them."""


Proposals = tuple[StateArray, StateArray, IntArray, StateArray, NDArray[np.int8]]
"""The arguments of ``TaskGenerator.choose_goals`` between the plan and the random numbers."""
ChooseGoals = Callable[[RoundPlan, Proposals, np.random.Generator], tuple[GoalChoice, np.random.Generator]]
"""``GeneratorWorker.choose_goals``, or a call of it in another process."""


@dataclass(frozen=True, slots=True)
class RoundSummary:
    """A played round in a few numbers; its rollout travels on its own."""

    id: RolloutId
    num_env_steps: int
    num_worlds: int
    num_diverged: int
    """Worlds whose physics diverged, in this incarnation."""
    diverged: Diverged
    """Those of this round."""
    play_s: float
    generator_s: float
    """Part of ``play_s``: waiting for the task generator."""
    pool_version: int
    metrics: Metrics


@dataclass(frozen=True, slots=True)
class GeneratorResult:
    """The task generator's result for an iteration."""

    metrics: Metrics
    should_stop: bool
    goals: NDArray[np.float64]
    """(M, 7) some of them for the run directory: start x y z, goal x y z (metres), solved 0/1."""


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """The learner's result for an iteration."""

    version: int
    metrics: Metrics
    counted: tuple[RolloutId, ...]
    """Ids of the rollouts learned from."""
    refused: tuple[RolloutId, ...]
    """Seen before, too old, or of a version this learner has not made."""
    update_s: float


class RolloutWorker:
    """Plays rounds on its own worlds.

    Consumes weights and an assignment, produces a rollout; asks for Bob's goals once a round, between the turns.

    Args:
        config: the run; ``game.num_worlds`` are this worker's.
        actor, incarnation: first parts of its rollouts' ids. The very first worker of a run draws from the random
            numbers of the run's seed.
        num_threads: native threads for physics; 0 for one per core.
    """

    def __init__(self, config: Config, actor: int = 0, incarnation: int = 0, *, num_threads: int = 0) -> None:
        self._config, self._num_threads = config, num_threads
        source = config.seed if (actor, incarnation) == (0, 0) else [config.seed, actor, incarnation]
        self.rng = np.random.default_rng(source)
        self.game = SelfPlay(config, self.rng, actor=actor, incarnation=incarnation, num_threads=num_threads)
        self.pool_version = -1
        self._past: list[tuple[StochasticPolicy, StochasticPolicy]] = []

    def play(self, weights: Weights, assignment: Assignment, choose_goals: ChooseGoals) -> tuple[Rollout, RoundSummary]:
        """Play a round in every world.

        Args:
            weights: the policy version to act with.
            assignment: from the task generator, made with this worker's random numbers.
            choose_goals: the task generator's choice of Bob's goals.

        Raises:
            DivergedError: a policy no longer acts in finite numbers.
        """
        start = time.perf_counter()
        self._accept(assignment)
        generator_s = 0.0

        def choose(*proposals: Any) -> GoalChoice:
            nonlocal generator_s
            asked = time.perf_counter()
            choice, rng = choose_goals(assignment.plan, proposals, self.rng)
            self.rng.bit_generator.state = rng.bit_generator.state
            generator_s = time.perf_counter() - asked
            return choice

        rollout = self.game.play_round(self._players(weights), assignment.plan, choose)
        return rollout, RoundSummary(
            id=rollout.id,
            num_env_steps=rollout.num_env_steps,
            num_worlds=self._config.game.num_worlds,
            num_diverged=self.game.worlds.num_diverged,
            diverged=rollout.diverged,
            play_s=time.perf_counter() - start,
            generator_s=generator_s,
            pool_version=self.pool_version,
            metrics=rollout.metrics,
        )

    def evaluate(self, weights: Weights, kinds: Sequence[GoalKind]) -> Metrics:
        """Bob's success without noise on the run's goals of some kinds, as metrics."""
        bob, episodes = numpy_bob(weights.bob_ema), self._config.run.evaluation_episodes
        return success_metrics(bob, self._config, kinds, episodes, seed=EVALUATION_SEED, num_threads=self._num_threads)

    def _accept(self, assignment: Assignment) -> None:
        self.rng.bit_generator.state = assignment.rng.bit_generator.state
        if assignment.pool is not None:
            pairs = zip(assignment.pool.alice, assignment.pool.bob, strict=True)
            self._past = [(NumpyGaussianPolicy(alice), numpy_bob(bob)) for alice, bob in pairs]
        self.pool_version = assignment.pool_version

    def _players(self, weights: Weights) -> Players:
        return Players(
            version=weights.version,
            alice=NumpyGaussianPolicy(weights.alice),
            bob=numpy_bob(weights.bob),
            past_alice=[alice for alice, _ in self._past],
            past_bob=[bob for _, bob in self._past],
        )


class GeneratorWorker:
    """The task generator, behind calls that give back what they changed.

    Consumes goal records, produces assignments and goals; waits for nothing.

    Args:
        config: the run.
        state: to continue from; None to start.
    """

    def __init__(self, config: Config, state: Mapping[str, NDArray[Any]] | None = None) -> None:
        layout = build_layout(config.world, blocked_fraction=config.game.blocked_gripper_fraction)
        self.generator = TaskGenerator(config, layout)
        self._pool_version = 0
        if state is not None:
            self.generator.load_state(state)
            self._pool_version = int(time.time_ns())  # no rollout worker can have it

    def assign(self, num_worlds: int, rng: np.random.Generator, known_pool: int) -> Assignment:
        """Choose the opponents in the next round of an actor with ``num_worlds``, whose random numbers these are."""
        rng = _copy(rng)
        plan = self.generator.plan(num_worlds, rng)
        pool = self.generator.opponents if known_pool != self._pool_version else None
        return Assignment(plan, rng, self._pool_version, pool)

    def choose_goals(
        self, plan: RoundPlan, proposals: Proposals, rng: np.random.Generator
    ) -> tuple[GoalChoice, np.random.Generator]:
        """Choose what Bob plays in a round, as ``TaskGenerator.choose_goals`` does.

        Returns:
            The choice, and the actor's random numbers after it.
        """
        rng = _copy(rng)
        return self.generator.choose_goals(plan, *proposals, rng), rng

    def record(self, iteration: int, weights: Weights, records: Sequence[GoalRecords]) -> GeneratorResult:
        """Learn from what became of an iteration's goals.

        Args:
            iteration: finished ones before it.
            weights: of the players of this iteration, who may become past opponents.
            records: of all its rounds.
        """
        joined = join_records(records)
        metrics = self.generator.record(joined)
        if self.generator.snapshot_due(iteration):
            self.generator.add_opponents(weights.alice, weights.bob)
            self._pool_version += 1
        return GeneratorResult(metrics, self.generator.should_stop(), sampled_goals(joined))

    def grid(self, iteration: int, num_env_steps: int) -> GoalGrid:
        """The cells in which a valid goal was ever proposed, as they are after ``iteration`` iterations."""
        grid = self.generator.grid
        maps = grid.maps()
        cells = tuple(
            GoalCell(
                center_m=tuple(np.round(maps["center"][tuple(at)], 4).tolist()),
                num_tries=int(maps["num_tries"][tuple(at)]),
                success_rate=round(float(maps["success_rate"][tuple(at)]), 4),
                learnability=round(float(maps["learnability"][tuple(at)]), 4),
            )
            for at in np.argwhere(maps["seen"])
        )
        lower, upper = grid.bounds_m
        return GoalGrid(
            iteration=iteration,
            num_env_steps=num_env_steps,
            cell_size_m=grid.cell_size_m,
            shape=grid.shape,
            num_cells=int(np.prod(grid.shape)),
            lower_m=lower,
            upper_m=upper,
            cells=cells,
        )


class LearnerWorker:
    """The learner, behind one call for an update.

    Consumes rollouts, produces weights and metrics; waits for nothing.

    Args:
        config: the run.
        state: to continue from; None to start.
        pending: rollout to be learned from with the next ones.
        group: of the ranks that learn together; None where this is the only one.
    """

    def __init__(
        self,
        config: Config,
        state: Arrays | None = None,
        pending: Rollout | None = None,
        group: Group | None = None,
    ) -> None:
        import torch  # here, not where runs are only read

        from service.learner.learner import Learner

        torch.set_num_threads(config.learner.num_threads)
        self.learner = Learner(config) if group is None else Learner(config, group)
        if state is not None:
            self.learner.load_state(state)
        if pending is not None:
            self.learner.ingest(pending)

    def update(self, rollouts: Sequence[Rollout]) -> UpdateResult:
        """Learn from rollouts; makes the next version.

        Raises:
            LearnerError: none of them could be learned from.
        """
        start = time.perf_counter()
        taken = [rollout for rollout in rollouts if self.learner.ingest(rollout)]
        metrics = self.learner.update()
        counted = tuple(rollout.id for rollout in taken)
        refused = tuple(rollout.id for rollout in rollouts if rollout.id not in counted)
        return UpdateResult(self.learner.version, metrics, counted, refused, time.perf_counter() - start)


def _copy(rng: np.random.Generator) -> np.random.Generator:
    """Copy random numbers: the arguments of a call that may be tried again must not change."""
    copy = np.random.default_rng()
    copy.bit_generator.state = rng.bit_generator.state
    return copy
