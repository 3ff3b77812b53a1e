"""The local runner: one process, the same parts as the cluster.

While one thread plays round i with the newest weights, another learns from round i-1: policy lag is exactly 1, both
cores of a laptop are busy, and the order of everything is fixed, so a run is reproducible bit for bit.
"""

from __future__ import annotations

import logging
import os
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from service.actors.evaluation import evaluate
from service.actors.rollout import Rollout, from_arrays, to_arrays
from service.actors.self_play import Acting, Players, SelfPlay
from service.config import Config
from service.generator.generator import TaskGenerator
from service.io.run_directory import RunDirectory
from service.policies.evaluator import GaussianEvaluator, bob_evaluator
from service.policies.parameters import Parameters
from service.runtime.bookkeeping import Books
from service.runtime.runner import EVALUATED_GOALS, EVALUATION_SEED, Health, Metrics, OnBeat, OnIteration, RunResult
from service.runtime.telling import goal_grid
from service.runtime.timing import Timing
from service.store.models import ActorStatus, GoalGrid

if TYPE_CHECKING:
    from service.learner.weights import Weights

_logger = logging.getLogger(__name__)


class LocalRun:
    """A pre-training run in this process.

    Args:
        config: the run.
        directory: where it keeps everything; see ``RunDirectory``.
        resume: continue from the newest checkpoint instead of starting anew.

    Raises:
        TandemError: see ``RunDirectory.claim``.
        CheckpointError: ``resume`` without a usable checkpoint.
    """

    def __init__(self, config: Config, directory: RunDirectory, *, resume: bool = False) -> None:
        import torch  # here, not by those who only read runs

        from service.learner.learner import Learner

        directory.claim(resume=resume)
        torch.set_num_threads(config.learner.num_threads)
        self.config = config
        self.directory = directory
        self.timing = Timing()
        self._rng = np.random.default_rng(config.seed)
        self.learner = Learner(config)
        self._incarnation = 0
        self.game = SelfPlay(config, self._rng, num_threads=config.run.num_threads)
        self.generator = TaskGenerator(config, self.game.worlds.layout)
        self.books = Books(config, directory)
        self._stop_requested = False
        self._past: list[tuple[Acting, Acting]] = []
        self._pending: Rollout | None = None
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="learner")
        if resume:
            self._load()
        else:
            self.save()  # so that a run killed before its first interval can be resumed, too
            self._take_snapshot(after=-1)
        after = {"after_iteration": self.iteration, "after_env_steps": self.num_env_steps} if resume else {}
        directory.start(config, **after)

    @property
    def iteration(self) -> int:
        """Finished iterations."""
        return self.books.iteration

    @property
    def num_env_steps(self) -> int:
        """Of both players."""
        return self.books.num_env_steps

    def bob(self) -> Parameters:
        """The newest Bob, as he is evaluated and published."""
        return self.learner.weights().steady_bob

    def health(self) -> Health:
        """Of the one actor there is, this process."""
        actor = ActorStatus(
            name="rollout-0",
            incarnation=0,
            state="alive",
            pid=os.getpid(),
            heartbeat=datetime.now(UTC),
            num_rollouts=self.iteration,
            num_env_steps=self.num_env_steps,
        )
        return Health((actor,), num_rollouts_counted=max(0, self.iteration - 1))  # the newest is learned from next

    def grid(self) -> GoalGrid:
        """What the task generator knows about goals."""
        return goal_grid(self.generator, self.iteration, self.num_env_steps)

    def close(self) -> None:
        """End the threads; a second call does nothing."""
        self._executor.shutdown()
        self.game.close()

    def request_stop(self) -> None:
        """End after the current iteration, with a checkpoint. Safe to call from a signal handler."""
        self._stop_requested = True

    def run(
        self, on_iteration: OnIteration = lambda metrics: None, on_beat: OnBeat = lambda: None
    ) -> RunResult:  # an iteration is short: ``on_beat`` is never needed
        """Play, learn, record, until the budget is spent, the stop criterion holds, or a stop is requested.

        Raises:
            DivergedError: a policy has.
            UnsavedError: the last checkpoint could not be written; earlier ones that could not are only warned of.
        """
        while (reason := self._over()) is None:
            before = self.num_env_steps
            with self.books.diverging():
                metrics = self._iterate()
            with self.timing("record"):
                self.directory.record(metrics)
                on_iteration(metrics)
            with self.books.going_on("without this snapshot"):
                self._take_snapshot(after=before)
            if self.books.save_due:
                with self.books.going_on(f"and saves again after {self.config.run.checkpoint_interval} iterations"):
                    self.save()
        self._save_last()
        self.close()
        return RunResult(reason, self.iteration, self.num_env_steps)

    def _over(self) -> str | None:
        if self._stop_requested:
            return "interrupted"
        if self.books.budget_spent:
            return "finished"
        return "converged" if self.generator.should_stop() else None

    def _iterate(self) -> Metrics:
        """Consumes the pending rollout and produces the next one; waits for play and learning both."""
        start = time.perf_counter()
        with self.timing("weights"):
            weights = self.learner.weights()
            players = self._players(weights)
        learning = self._executor.submit(self._learn, self._pending)
        with self.timing("play"):
            rollout = self._play(players)
        with self.timing("generator"):
            metrics = rollout.metrics | self.generator.record(rollout.records)
            self.directory.record_goals(self.iteration, self.num_env_steps + rollout.num_env_steps, rollout.records)
            self.directory.dump_broken(f"{rollout.sequence:06d}", rollout.broken)
            if self.generator.snapshot_due(self.iteration):
                self.generator.add_opponents(weights.alice, weights.bob)
                self._past = []
        with self.timing("wait for learner"):
            metrics |= learning.result()
        self._pending = rollout
        self.books.count(rollout.num_env_steps)
        with self.timing("evaluate"):
            metrics |= self._evaluate(weights)
        elapsed_s = time.perf_counter() - start
        self.books.wall_s += elapsed_s
        return {
            "iteration": self.iteration,
            "env_steps": self.num_env_steps,
            "world/num_broken": float(self.game.worlds.num_broken),
            **metrics,
            "time/learner_idle_fraction": max(0.0, 1.0 - metrics.get("time/learn_s", 0.0) / elapsed_s),
            "time/wall_s": self.books.wall_s,
            "time/env_steps_per_s": rollout.num_env_steps / elapsed_s,
        }

    def _play(self, players: Players) -> Rollout:
        plan = self.generator.plan(self.config.game.num_worlds, self._rng)
        return self.game.play_round(players, plan, partial(self.generator.choose_goals, plan, rng=self._rng))

    def _learn(self, rollout: Rollout | None) -> Metrics:
        """Runs in the learner's thread; the main thread does not touch the learner meanwhile."""
        if rollout is None:
            return {}
        start = time.perf_counter()
        lag = self.learner.version - rollout.policy_version
        self.learner.ingest(rollout)
        metrics = self.learner.update()
        return {**metrics, "learner/policy_lag": float(lag), "time/learn_s": time.perf_counter() - start}

    def _players(self, weights: Weights) -> Players:
        if not self._past:
            pool = self.generator.opponents
            self._past = [(GaussianEvaluator(a), bob_evaluator(b)) for a, b in zip(pool.alice, pool.bob, strict=True)]
        return Players(
            version=weights.version,
            alice=GaussianEvaluator(weights.alice),
            bob=bob_evaluator(weights.bob),
            past_alice=[alice for alice, _ in self._past],
            past_bob=[bob for _, bob in self._past],
        )

    def _evaluate(self, weights: Weights) -> Metrics:
        run, game = self.config.run, self.config.game
        if not self.books.evaluation_due:
            return {}
        metrics, bob = {}, bob_evaluator(weights.steady_bob)
        for kind in EVALUATED_GOALS:
            result = evaluate(
                bob,
                self.config.world,
                kind,
                num_episodes=run.evaluation_episodes,
                num_steps=run.evaluation_steps,
                success_distance_m=game.success_distance_m,
                seed=EVALUATION_SEED,
                num_threads=run.num_threads,
            )
            metrics[f"evaluation/{kind}_success_last"] = result.success_last
            metrics[f"evaluation/{kind}_success_ever"] = result.success_ever
        return metrics

    def _take_snapshot(self, *, after: int) -> None:
        if self.books.snapshot_due(after=after):
            with self.timing("checkpoint"):
                self.books.take_snapshot(self.bob())

    def _save_last(self) -> None:
        with self.books.saving_last():
            if not self.books.saved:
                self.save()

    # --- exact resume ----------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Write a checkpoint: with it alone a new process goes on bit-identically."""
        with self.timing("checkpoint"):
            parts = {"learner": self.learner.state(), "generator": self.generator.state(), "game": self.game.state()}
            weights = self.learner.weights()  # for readers without torch: evaluate, render, coverage
            parts |= {"alice": weights.alice, "bob": weights.steady_bob}
            if self._pending is not None:
                parts["pending"] = to_arrays(self._pending)
            meta = {"rng": self._rng.bit_generator.state, "next_incarnation": self._incarnation + 1}
            self.books.save(parts, meta)

    def _load(self) -> None:
        parts, meta = self.books.resume()
        self.learner.load_state(parts["learner"])
        self.generator.load_state(parts["generator"])
        next_incarnation = int(meta.get("next_incarnation", 1))
        # The same actor goes on. A cluster's are no part of a checkpoint: after them another begins.
        self._incarnation = next_incarnation - 1 if "game" in parts else next_incarnation
        if "game" in parts:
            self.game.load_state(parts["game"])
        self.game.incarnation = self._incarnation
        self._pending = from_arrays(parts["pending"]) if "pending" in parts else None
        self._rng.bit_generator.state = meta["rng"]
