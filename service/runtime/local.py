"""The local runner: one process, the same workers as on a cluster.

While one thread plays round i with the newest weights, another learns from round i-1: policy lag is exactly 1, both
cores of a laptop are busy, and the order of everything is fixed, so a run is reproducible bit for bit.
"""

from __future__ import annotations

import logging
import time
from concurrent.futures import ThreadPoolExecutor

from service.actors.evaluation import EVALUATED_GOALS
from service.actors.rollout import Rollout, from_arrays, to_arrays
from service.config import Config
from service.envs.observations import layouts
from service.errors import ConfigError, TandemError
from service.generator.opponents import Opponents
from service.io.run_directory import RunDirectory
from service.policies.parameters import Parameters
from service.runtime.runner import Health, IterationResult, OnBeat, Runner
from service.runtime.starting import Start
from service.runtime.workers import GeneratorWorker, LearnerWorker, RolloutWorker
from service.store.models import GoalGrid
from service.types import Metrics

_logger = logging.getLogger(__name__)
OLDER_OPPONENTS = -1
"""Version of past players that a checkpoint has beside the task generator's, which have joined meanwhile."""


def check_one_learner(config: Config) -> None:
    """Check that a run can be one of this runner.

    Raises:
        ConfigError: its learner has several processes.
    """
    if config.learner.num_learners > 1:
        raise ConfigError(
            f"learner.num_learners = {config.learner.num_learners}: the local runner has one process; use "
            "--runtime ray, or --set learner.num_learners=1 (what is learned is the same)"
        )


class LocalRun(Runner):
    """A pre-training run in this process.

    Args:
        config: the run.
        directory: where it keeps everything; see ``RunDirectory``.
        resume: continue from the newest checkpoint instead of starting anew.
        start: what a new run begins from; None: from nothing.

    Raises:
        TandemError: see ``RunDirectory.claim`` and ``check_one_learner``; or nothing of ``start`` fits.
        CheckpointError: ``resume`` without a usable checkpoint.
    """

    def __init__(
        self, config: Config, directory: RunDirectory, *, resume: bool = False, start: Start | None = None
    ) -> None:
        check_one_learner(config)
        directory.claim(resume=resume)
        super().__init__(config, directory)
        self._incarnation = 0
        self._pending: Rollout | None = None
        self._learner = LearnerWorker(config)
        self._actor = RolloutWorker(config, num_threads=config.run.num_threads)
        self._generator = GeneratorWorker(config)
        self.learner, self.game, self.generator = self._learner.learner, self._actor.game, self._generator.generator
        self._snapshot, self._opponents = self.generator.snapshot(), self._generator.opponents()
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="learner")
        if resume:
            self._load()
        else:
            if start is not None:
                self._begin_from(start)
            self._save_first()
        self._open_directory(resume=resume)

    def parameters(self) -> Parameters:
        """The newest Bob, as he is evaluated and published."""
        return self.learner.weights().bob_ema

    def health(self) -> Health:
        """The state of the one actor there is, this process."""
        return self._health_of_one(num_rollouts_counted=max(0, self.iteration - 1))  # the newest is learned from next

    def grid(self) -> GoalGrid:
        """The task generator's goal grid."""
        return self._generator.grid(self.iteration, self.num_env_steps)

    def close(self) -> None:
        """End the threads; a second call does nothing."""
        self._executor.shutdown()
        self.game.close()

    def _advance(self, on_beat: OnBeat) -> None:
        """Play one iteration, which is short: ``on_beat`` is never needed."""
        start = time.perf_counter()
        with self.bookkeeper.explaining_divergence():
            result, evaluated = self._iterate()
        elapsed_s = time.perf_counter() - start
        self.bookkeeper.wall_s += elapsed_s
        self._record(result, self._metrics(result, elapsed_s) | evaluated)

    def _iterate(self) -> tuple[IterationResult, Metrics]:
        """Consume the pending rollout and produce the next one; waits for play and learning both."""
        with self.timing("weights"):
            weights, snapshot, opponents = self.learner.weights(), self._snapshot, self._opponents
            # For the next round, and as old as its weights will be.
            self._snapshot, self._opponents = self.generator.snapshot(), self._generator.opponents()
        learning = self._executor.submit(self._learner.update, [self._pending]) if self._pending is not None else None
        with self.timing("play"):
            rollout, goals, summary = self._actor.play(weights, snapshot, opponents)
        with self.timing("generator"):
            recorded = self._generator.record(self.iteration, weights, [goals])
            self.directory.dump_diverged(f"{rollout.sequence:06d}", rollout.diverged)
        with self.timing("evaluate"):  # the players of this round, while the learner goes on
            due = self.bookkeeper.evaluation_due(self.iteration + 1)
            evaluated = self._actor.evaluate(weights, EVALUATED_GOALS) if due else {}
        with self.timing("wait for learner"):
            updated = learning.result() if learning is not None else None
        self._pending = rollout
        result = IterationResult([summary], recorded, updated, num_actors_alive=1)
        self._count(result)
        return result, evaluated

    # --- exact resume ----------------------------------------------------------------------------------------------

    def _save(self) -> None:
        """Write a checkpoint: with it alone a new process goes on bit-identically."""
        with self.timing("checkpoint"):
            weights = self.learner.weights()
            parts = {
                "learner": self.learner.state(),
                "generator": self.generator.state(),
                "snapshot": self._snapshot.state(),
                "game": self.game.state(),
                "alice": weights.alice,  # for readers without torch: evaluate, render, coverage
                "bob": weights.bob_ema,
            }
            if self._opponents.version != self._generator.opponents().version:
                parts["opponents"] = self._opponents.state()
            if self._pending is not None:
                parts["pending"] = to_arrays(self._pending)
            meta = {"rng": self._actor.rng.bit_generator.state, "next_incarnation": self._incarnation + 1}
            self.bookkeeper.save(parts, meta)

    def _begin_from(self, start: Start) -> None:
        lines = self.learner.take_over(start.networks, layouts(start.world))
        if not any(": taken" in line for line in lines):  # or a run from nothing would have it as its parent
            raise TandemError(
                f"--from {start.reference}: nothing of it fits: {lines[0]}; give this run the sizes of that one's "
                "networks (policy), or leave out --from"
            )
        for line in lines:
            _logger.info("from %s: %s", start.reference, line)
        if start.published is not None:
            self.directory.write_published(start.published)

    def _load(self) -> None:
        parts, meta = self.bookkeeper.resume()
        self.learner.load_state(parts["learner"])
        self.generator.load_state(parts["generator"])
        self._snapshot, self._opponents = self.generator.snapshot(), self._generator.opponents()
        if "snapshot" in parts:  # a cluster's checkpoint has none
            self._snapshot = self._snapshot.with_state(parts["snapshot"])
        if "opponents" in parts:
            self._opponents = Opponents.from_state(OLDER_OPPONENTS, parts["opponents"])
        next_incarnation = int(meta.get("next_incarnation", 1))
        # The same actor goes on. A cluster's are no part of a checkpoint: after them another begins.
        self._incarnation = next_incarnation - 1 if "game" in parts else next_incarnation
        if "game" in parts:
            self.game.load_state(parts["game"])
        self.game.incarnation = self._incarnation
        self._pending = from_arrays(parts["pending"]) if "pending" in parts else None
        self._actor.rng.bit_generator.state = meta["rng"]
