"""What runs in the cluster's processes: one round at a time, the learner, the task generator.

They are plain classes around the same parts that the local runner uses; ``cluster`` makes Ray actors of them. Arrays
that come through Ray's object store are read-only and are never written to.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from service.actors.evaluation import evaluate
from service.actors.rollout import Broken, Rollout
from service.actors.self_play import Acting, Players, SelfPlay
from service.config import Config
from service.envs.goals import GoalKind
from service.envs.scene import build_layout
from service.generator.generator import GoalChoice, TaskGenerator
from service.generator.opponents import RoundPlan
from service.generator.records import GoalRecords
from service.io.run_directory import sampled_goals
from service.policies.evaluator import GaussianEvaluator, bob_evaluator
from service.policies.parameters import Parameters
from service.runtime.telling import goal_grid
from service.store.models import GoalGrid

if TYPE_CHECKING:
    from service.learner.weights import Weights

Arrays = dict[str, NDArray[Any]]
StateArray = NDArray[np.float64]
RolloutId = tuple[int, int, int]
Metrics = dict[str, float]

GENERATOR_TIMEOUT_S = 30.0
"""It answers within milliseconds, if it is there."""
NICENESS = 10
"""Of who computes, above that of who answers: a tenth of the share of a core that both want."""


class GeneratorGoneError(RuntimeError):
    """The task generator did not answer in the middle of a round; the round is given up."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a worker runs."""

    node: str
    pid: int


@dataclass(frozen=True, slots=True)
class Pool:
    """The generator's past opponents, as of its ``version``."""

    version: int
    alice: Sequence[Parameters]
    bob: Sequence[Parameters]


@dataclass(frozen=True, slots=True)
class Assignment:
    """What a round is played by."""

    plan: RoundPlan
    rng: np.random.Generator
    """The actor's, advanced by the plan."""
    pool_version: int
    pool: Pool | None
    """None where the actor has this version."""


@dataclass(frozen=True, slots=True)
class Round:
    """A played round in a few numbers; its rollout travels on its own."""

    id: RolloutId
    policy_version: int
    num_env_steps: int
    num_worlds: int
    num_broken: int
    """Worlds whose physics diverged, in this incarnation."""
    broken: Broken
    """Those of this round."""
    play_s: float
    generator_s: float
    """Of it, waiting for the task generator."""
    pool_version: int
    metrics: Metrics


@dataclass(frozen=True, slots=True)
class Recorded:
    """What the task generator says to an iteration's goals."""

    metrics: Metrics
    should_stop: bool
    grid: GoalGrid
    sample: GoalRecords
    """Some of the goals, for the run directory."""


@dataclass(frozen=True, slots=True)
class Updated:
    """What the learner says to an update."""

    version: int
    metrics: Metrics
    counted: tuple[RolloutId, ...]
    """Ids of the rollouts learned from."""
    refused: tuple[RolloutId, ...]
    """Seen before, too old, or of a version this learner has not made."""
    update_s: float


def place() -> Place:
    """Of this process."""
    return Place(socket.gethostname(), os.getpid())


def give_way() -> None:
    """Who computes all the time goes behind who answers now and then: driver, status service, Redis, Ray itself.

    To be called before threads are started; they inherit it.
    """
    if hasattr(os, "nice"):
        os.nice(NICENESS)


class RolloutWorker:
    """Plays rounds on its own worlds.

    Consumes weights and an assignment, produces a rollout; waits for the task generator once a round, between turns.

    Args:
        config: the run; ``game.num_worlds`` are this worker's.
        actor, incarnation: first parts of its rollouts' ids. The very first worker of a run draws from the same random
            numbers as the local runner does.
        num_threads: native threads for physics.
    """

    def __init__(self, config: Config, actor: int, incarnation: int, num_threads: int) -> None:
        give_way()
        self._config, self._actor, self._incarnation = config, actor, incarnation
        self._num_threads = num_threads
        source = config.seed if (actor, incarnation) == (0, 0) else [config.seed, actor, incarnation]
        self._rng = np.random.default_rng(source)
        self._game = SelfPlay(config, self._rng, actor=actor, incarnation=incarnation, num_threads=num_threads)
        self._past: list[tuple[Acting, Acting]] = []
        self._pool_version = 0
        self._count = _actor_metrics(actor)

    def ping(self) -> tuple[Place, np.random.Generator]:
        """Where it runs, and the state of its random numbers, which the first assignment advances."""
        return place(), self._rng

    def play(
        self, weights: Weights, assignment: Assignment, generator: Any
    ) -> tuple[Rollout, GoalRecords, np.random.Generator, Round]:
        """Play a round in every world.

        Args:
            weights: the policy version to act with.
            assignment: from the task generator, made with this worker's random numbers.
            generator: handle of the task generator.

        Returns:
            The rollout, its records again for the generator, this worker's random numbers, and the round's numbers.

        Raises:
            GeneratorGoneError: the generator died meanwhile; the next round starts from resets.
            DivergedError: a policy no longer acts in finite numbers.
        """
        start = time.perf_counter()
        self._take(assignment)
        waited = 0.0

        def choose_goals(*proposals: Any) -> GoalChoice:
            nonlocal waited
            asked = time.perf_counter()
            choice, rng = _ask(generator, assignment.plan, *proposals, self._rng)
            self._rng.bit_generator.state = rng.bit_generator.state
            waited = time.perf_counter() - asked
            return choice

        try:
            rollout = self._game.play_round(self._players(weights), assignment.plan, choose_goals)
        except GeneratorGoneError:
            self._game.start_over()
            raise
        play_s = time.perf_counter() - start
        self._count(rollout.num_env_steps, play_s)
        numbers = Round(
            id=rollout.id,
            policy_version=rollout.policy_version,
            num_env_steps=rollout.num_env_steps,
            num_worlds=self._config.game.num_worlds,
            num_broken=self._game.worlds.num_broken,
            broken=rollout.broken,
            play_s=play_s,
            generator_s=waited,
            pool_version=self._pool_version,
            metrics=rollout.metrics,
        )
        return rollout, rollout.records, self._rng, numbers

    def evaluate(self, weights: Weights, kind: GoalKind, seed: int) -> Metrics:
        """Bob's success without noise on random goals of one kind, as metrics."""
        run = self._config.run
        result = evaluate(
            bob_evaluator(weights.steady_bob),
            self._config.world,
            kind,
            num_episodes=run.evaluation_episodes,
            num_steps=run.evaluation_steps,
            success_distance_m=self._config.game.success_distance_m,
            seed=seed,
            num_threads=self._num_threads,
        )
        return {
            f"evaluation/{kind}_success_last": result.success_last,
            f"evaluation/{kind}_success_ever": result.success_ever,
        }

    def _take(self, assignment: Assignment) -> None:
        self._rng.bit_generator.state = assignment.rng.bit_generator.state
        if assignment.pool is not None:
            pairs = zip(assignment.pool.alice, assignment.pool.bob, strict=True)
            self._past = [(GaussianEvaluator(alice), bob_evaluator(bob)) for alice, bob in pairs]
        self._pool_version = assignment.pool_version

    def _players(self, weights: Weights) -> Players:
        return Players(
            version=weights.version,
            alice=GaussianEvaluator(weights.alice),
            bob=bob_evaluator(weights.bob),
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

    def __init__(self, config: Config, state: Arrays | None) -> None:
        layout = build_layout(config.world, blocked_fraction=config.game.blocked_gripper_fraction)
        self._generator = TaskGenerator(config, layout)
        self._config = config
        self._pool_version = 0
        if state is not None:
            self._generator.load_state(state)
            self._pool_version = int(time.time_ns())  # no worker can have it

    def ping(self) -> Place:
        """Where it runs."""
        return place()

    def begin(self) -> Arrays:
        """Its state before the first iteration."""
        return self._generator.state()

    def assign(self, num_worlds: int, rng: np.random.Generator, known_pool: int) -> Assignment:
        """Who plays the next round of an actor with ``num_worlds``, whose random numbers these are."""
        rng = _own(rng)
        plan = self._generator.plan(num_worlds, rng)
        opponents = self._generator.opponents
        pool = Pool(self._pool_version, list(opponents.alice), list(opponents.bob))
        return Assignment(plan, rng, self._pool_version, pool if known_pool != self._pool_version else None)

    def choose_goals(
        self,
        plan: RoundPlan,
        start_state: StateArray,
        start_position: StateArray,
        round_index: NDArray[np.int64],
        proposal: StateArray,
        verdict: NDArray[np.int8],
        rng: np.random.Generator,
    ) -> tuple[GoalChoice, np.random.Generator]:
        """What Bob plays in a round, see ``TaskGenerator.choose_goals``, and the actor's random numbers after it."""
        rng = _own(rng)
        proposals = start_state, start_position, round_index, proposal, verdict
        return self._generator.choose_goals(plan, *proposals, rng), rng

    def record(self, iteration: int, num_env_steps: int, weights: Weights, records: Sequence[Any]) -> Any:
        """Learn from what became of an iteration's goals, given as object references.

        Returns:
            What it says to them, and its whole state.
        """
        import ray

        joined = join_records(ray.get(list(records)))
        metrics = self._generator.record(joined)
        if self._generator.snapshot_due(iteration):
            self._generator.add_opponents(weights.alice, weights.bob)
            self._pool_version += 1
        grid = goal_grid(self._generator, iteration + 1, num_env_steps)
        sample = rows_of(joined, sampled_goals(joined))
        return Recorded(metrics, self._generator.should_stop(), grid, sample), self._generator.state()


class LearnerWorker:
    """The learner, behind calls that give back all it knows, so that nothing is lost with it.

    Consumes rollouts, produces weights, its whole state and metrics; waits for nothing.

    Args:
        config: the run.
        state: to continue from; None to start.
        pending: a rollout to be learned from with the next ones.
    """

    def __init__(self, config: Config, state: Arrays | None, pending: Rollout | None = None) -> None:
        import torch

        from service.learner.learner import Learner

        give_way()
        torch.set_num_threads(config.learner.num_threads)
        self._learner = Learner(config)
        if state is not None:
            self._learner.load_state(state)
        if pending is not None:
            self._learner.ingest(pending)

    def ping(self) -> Place:
        """Where it runs."""
        return place()

    def begin(self) -> tuple[Weights, Arrays]:
        """Weights and state before the first update."""
        return self._learner.weights(), self._learner.state()

    def update(self, references: Sequence[Any]) -> tuple[Weights, Arrays, Updated]:
        """Learn from rollouts, given as object references; makes the next version.

        Raises:
            LearnerError: none of them could be learned from.
        """
        import ray

        start = time.perf_counter()
        rollouts: list[Rollout] = ray.get(list(references))
        version = self._learner.version
        taken = [rollout for rollout in rollouts if self._learner.ingest(rollout)]
        metrics = self._learner.update()
        if taken:
            lags = [version - rollout.policy_version for rollout in taken]
            metrics |= {"learner/policy_lag": float(np.mean(lags)), "learner/max_policy_lag": float(max(lags))}
        weights, state = self._learner.weights(), self._learner.state()
        update_s = time.perf_counter() - start
        counted = tuple(rollout.id for rollout in taken)
        refused = tuple(rollout.id for rollout in rollouts if rollout.id not in counted)
        return weights, state, Updated(weights.version, metrics, counted, refused, update_s)


def join_records(records: Sequence[GoalRecords]) -> GoalRecords:
    """Records of several rounds as one of all their worlds."""
    if len(records) == 1:
        return records[0]
    names = [field.name for field in fields(GoalRecords)]
    return GoalRecords(**{name: np.concatenate([getattr(each, name) for each in records]) for name in names})


def rows_of(records: GoalRecords, rows: NDArray[np.int64]) -> GoalRecords:
    """Some of the worlds' records."""
    return GoalRecords(**{field.name: getattr(records, field.name)[rows] for field in fields(GoalRecords)})


def _ask(generator: Any, *arguments: Any) -> tuple[GoalChoice, np.random.Generator]:
    """The generator's choice of goals; a generator that is gone must not be taken for the end of this worker."""
    import ray

    try:
        choice, rng = ray.get(generator.choose_goals.remote(*arguments), timeout=GENERATOR_TIMEOUT_S)
    except (ray.exceptions.RayActorError, ray.exceptions.GetTimeoutError) as error:
        raise GeneratorGoneError(f"the task generator did not answer: {type(error).__name__}") from None
    return choice, rng


def _own(rng: np.random.Generator) -> np.random.Generator:
    """A copy: what comes as an argument of a call that is tried again must not have moved."""
    own = np.random.default_rng()
    own.bit_generator.state = rng.bit_generator.state
    return own


def _actor_metrics(actor: int) -> Any:
    """Counts a round for Prometheus, on the metrics port of the actor's node (``ray_tandem_...``)."""
    from ray.util.metrics import Counter, Histogram

    tags = {"actor": str(actor)}
    steps = Counter("tandem_actor_env_steps", "Env steps simulated.", tag_keys=("actor",))
    rounds = Counter("tandem_actor_rounds", "Rounds played.", tag_keys=("actor",))
    seconds = Histogram(
        "tandem_actor_round_seconds", "Duration of a round.", boundaries=[0.5, 1, 2, 5, 10, 30], tag_keys=("actor",)
    )

    def count(num_env_steps: int, play_s: float) -> None:
        steps.inc(num_env_steps, tags)
        rounds.inc(1, tags)
        seconds.observe(play_s, tags)

    return count
