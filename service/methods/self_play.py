"""Self-play: Alice proposes goals, Bob learns to reach them.

What is learned is the same wherever its three workers are: in this process, ``LocalSelfPlay``, or on a Ray cluster.

``LocalSelfPlay``: while one thread plays round i with the newest weights, another learns from round i-1. Policy lag is
exactly 1, both cores of a laptop are busy, and the order of everything is fixed, so a run is reproducible bit for bit.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from service.actors.evaluation import evaluated_goals
from service.actors.rollout import Rollout, from_arrays, to_arrays
from service.base.errors import TandemError
from service.base.types import Metrics
from service.base.user_code import recorded
from service.config.self_play import GOAL_SOURCES, SelfPlayConfig
from service.envs.observations import layouts
from service.generator.opponents import Opponents
from service.generator.sources import check_source
from service.methods.method import Health, Iteration, Method, State
from service.methods.workers import GeneratorWorker, RolloutWorker, RoundSummary
from service.policies.parameters import Parameters
from service.registry.loading import Trained
from service.registry.publishing import measure_bob
from service.store.models import GoalGrid

_logger = logging.getLogger(__name__)
OLDER_OPPONENTS = -1
"""Version of past opponents that a checkpoint keeps for a round not learned yet; those of the task generator differ."""


class SelfPlay(Method):
    """What self-play has in common wherever its workers are."""

    def __init__(self, config: SelfPlayConfig) -> None:
        super().__init__()
        self.config = config

    @property
    def remedy(self) -> str:
        """Lower learning rates, with which the run may go on."""
        learner = self.config.learner
        rates = f"alice.learning_rate={learner.alice.learning_rate / 2:g} --set learner.bob.learning_rate="
        return (
            "resume with lower learning rates, for example --resume --set learner."
            f"{rates}{learner.bob.learning_rate / 2:g}"
        )

    def measure(self) -> Metrics:
        """Success of the newest Bob on every kind of goals."""
        return measure_bob(self.config, self.parameters())

    def _finish(
        self,
        rounds: Sequence[RoundSummary],
        recorded: Iteration,
        learned: Metrics,
        *,
        elapsed_s: float,
        num_alive: int = 1,
        hand_over_s: float = 0.0,
    ) -> Iteration:
        """Count an iteration, and put together what it leaves behind.

        Args:
            rounds: that were played.
            recorded: the task generator's part.
            learned: the learner's metrics; none where there was nothing to learn from yet.
            elapsed_s: duration of the iteration.
            num_alive: actors that have started.
            hand_over_s: mean time that a round's result was on its way or in line.
        """
        counted = self.count(sum(each.num_env_steps for each in rounds))
        metrics = {
            **counted,
            **_round_metrics(rounds),
            **recorded.metrics,
            **learned,
            "actor/num_rollouts": float(len(rounds)),
            "actor/num_alive": float(num_alive),
            "time/hand_over_s": hand_over_s,
            "time/learner_idle_fraction": max(0.0, 1.0 - learned.get("time/learn_s", 0.0) / elapsed_s),
        }
        diverged = {"-".join(map(str, each.id)): each.diverged for each in rounds if each.diverged}
        return Iteration(metrics, recorded.goals, diverged)


class LocalSelfPlay(SelfPlay):
    """Self-play in this process.

    Args:
        config: the run.
        start_from: what a new run begins from; None: from nothing.
    """

    def __init__(self, config: SelfPlayConfig, start_from: Trained | None = None) -> None:
        from service.learner.learner import Learner  # here: a cluster's driver needs no torch

        super().__init__(config)
        self._incarnation = 0
        self._pending: Rollout | None = None
        self.learner = Learner(config)
        self._actor = RolloutWorker(config, num_threads=config.run.num_threads)
        self._generator = GeneratorWorker(config)
        self.game, self.generator = self._actor.game, self._generator.generator
        self._snapshot, self._opponents = self.generator.snapshot(), self.generator.opponents
        self._played = self.learner.weights()
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="learner")
        if start_from is not None:
            self._take_over(start_from)

    def step(self) -> Iteration:
        """Consume the pending rollout and produce the next one; waits for play and learning both."""
        begun = time.perf_counter()
        with self.timing("weights"):
            weights, snapshot, opponents = self.learner.weights(), self._snapshot, self._opponents
            # For the next round, and as old as its weights will be.
            self._snapshot, self._opponents = self.generator.snapshot(), self.generator.opponents
        learning = None
        if self._pending is not None:
            self.learner.ingest(self._pending)
            learning = self._executor.submit(self.learner.update)
        with self.timing("play"):
            rollout, goals, summary = self._actor.play(weights, snapshot, opponents)
        with self.timing("generator"):
            recorded = self._generator.record(self.iteration, weights, [goals])
            self.converged = self.generator.should_stop()
        learned: Metrics = {}
        with self.timing("wait for learner"):
            if learning is not None:
                learned = learning.result() | {"time/learn_s": self.learner.update_s}
        self._pending, self._played = rollout, weights
        return self._finish([summary], recorded, learned, elapsed_s=time.perf_counter() - begun)

    def evaluate(self) -> Metrics:
        """Success of the Bob who played the last round on the run's goals, without noise."""
        return self._actor.evaluate(self._played, evaluated_goals(self.config.world, self.config.success_distance_m))

    def parameters(self) -> Parameters:
        """The newest Bob, as he is evaluated and published."""
        return self.learner.weights().bob_ema

    def health(self) -> Health:
        """The state of the one actor there is, this process."""
        actors = super().health().actors
        return Health(actors, num_rollouts_counted=max(0, self.iteration - 1))  # the newest is learned from next

    def grid(self) -> GoalGrid:
        """The task generator's goal grid."""
        return self._generator.grid(self.iteration, self.num_env_steps)

    def close(self) -> None:
        """End the threads; a second call does nothing."""
        self._executor.shutdown()
        self.game.close()

    def state(self) -> State:
        """Networks, optimisers, goals, worlds, random numbers and the rollout that is learned from next."""
        weights = self.learner.weights()
        parts = {
            "learner": self.learner.state(),
            "generator": self.generator.state(),
            "snapshot": self._snapshot.state(),
            "game": self.game.state(),
            "alice": weights.alice,  # for readers without torch: evaluate, render, coverage
            "bob": weights.bob_ema,
        }
        if self._opponents.version != self.generator.opponents.version:
            num = {"num": np.array(len(self._opponents.alice))}  # an empty part would leave no trace
            parts["opponents"] = self._opponents.state() | num
        if self._pending is not None:
            parts["pending"] = to_arrays(self._pending)
        return {
            **parts,
            "rng": self._actor.rng.bit_generator.state,
            "next_incarnation": self._incarnation + 1,
        }

    def load_state(self, state: State) -> None:
        """Continue from a state of this process or of a cluster."""
        self.learner.load_state(state["learner"])
        self.generator.load_state(state["generator"])
        self._snapshot, self._opponents = self.generator.snapshot(), self.generator.opponents
        if "snapshot" in state:  # a cluster's has none
            self._snapshot = self._snapshot.with_state(state["snapshot"])
        if "opponents" in state:
            self._opponents = Opponents.from_state(OLDER_OPPONENTS, state["opponents"])
        next_incarnation = int(state["next_incarnation"])
        # The same actor goes on. A cluster's are no part of a checkpoint: after them another begins.
        self._incarnation = next_incarnation - 1 if "game" in state else next_incarnation
        if "game" in state:
            self.game.load_state(state["game"])
        self.game.incarnation = self._incarnation
        self._pending = from_arrays(state["pending"]) if "pending" in state else None
        self._actor.rng.bit_generator.state = state["rng"]
        self.converged = self.generator.should_stop()

    def _take_over(self, start: Trained) -> None:
        lines = self.learner.take_over(start.networks, layouts(start.world))
        if not any(": taken" in line for line in lines):  # or a run from nothing would have it as its parent
            raise TandemError(
                f"--from {start.reference}: nothing of it fits: {lines[0]}; take one of such a world and networks of "
                "these sizes (policy), or leave out --from"
            )
        for line in lines:
            _logger.info("from %s: %s", start.reference, line)


def _round_metrics(rounds: Sequence[RoundSummary]) -> Metrics:
    """Means of the rounds' own metrics, weighted by their worlds, and how many worlds broke."""
    num_worlds = np.array([each.num_worlds for each in rounds], dtype=np.float64)
    shares = num_worlds / num_worlds.sum()
    means = {name: float(shares @ [each.metrics[name] for each in rounds]) for name in rounds[0].metrics}
    return means | {
        "world/num_broken": float(sum(len(each.diverged) for each in rounds)),
        "time/play_s": float(np.mean([each.play_s for each in rounds])),
    }


def begin(config: SelfPlayConfig, registry: Path | str, start_from: Trained | None) -> SelfPlayConfig:
    """The configuration, with the text of a source of goals of a user's.

    Raises:
        ConfigError: it does not run, or gives no goals.
    """
    if config.generator.goal_source in GOAL_SOURCES:
        return config
    exact = config.model_copy(update={"code": recorded(config.generator.goal_source, config.code)})
    check_source(exact)
    return exact


def check_here(config: SelfPlayConfig) -> None:
    """Check that the learner's device is on this machine."""
    from service.learner.learner import torch_device  # here: a cluster's driver needs no torch

    torch_device(config.learner.device)


def make(config: SelfPlayConfig, registry: Path | str, start_from: Trained | None) -> LocalSelfPlay:
    """Make self-play in this process."""
    return LocalSelfPlay(config, start_from)
