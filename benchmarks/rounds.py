"""Rounds of self-play without learning, and the same physics without the game."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring import Sample, Stopwatch, measure, total
from service.actors.rollout import Rollout
from service.actors.self_play import Players
from service.envs.batch import WorldBatch
from service.envs.observations import ACTION
from service.methods.self_play import LocalSelfPlay
from service.policies.numpy_policy import NumpyGaussianPolicy, numpy_bob
from service.runs.run import Run

RANDOM_STEPS = 50
"""Length of an episode of random actions."""

FloatArray = NDArray[np.float32]
StateArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Round:
    """A rollout, and the (N, S) states in which Alice began it."""

    start_state: StateArray
    rollout: Rollout


class Rounds:
    """Plays rounds in a run's worlds with its newest policies, and repeats their physics in worlds of its own.

    Args:
        run: its game goes on, its learner never hears of it.
    """

    def __init__(self, run: Run) -> None:
        self._run, self._play = run, self_play(run)
        self._rng = np.random.default_rng(0)
        game = run.config.game
        self._worlds = WorldBatch(
            run.config.world,
            game.num_worlds,
            num_threads=run.config.run.num_threads,
            blocked_fraction=game.blocked_gripper_fraction,
        )
        self.played: list[Round] = []
        """The rounds of the last ``play_and_repeat``."""

    def close(self) -> None:
        """Free the worlds."""
        self._worlds.close()

    def play_and_repeat(self, seconds: float) -> tuple[Sample, Sample]:
        """Rounds as the runner plays them, past opponents included, and after each its physics once more.

        Returns:
            What the rounds took, and what their physics alone took; both together take about ``seconds``.
        """
        players, watch = players_of(self._run), Stopwatch()
        self.played, whole, bare = [], [], []
        while not self.played or watch.wall_s() < seconds:
            whole.append(measure(lambda: self._play_round(players), 0.0))
            bare.append(measure(lambda: repeat_physics(self._worlds, self.played[-1]), 0.0))
        return total(whole), total(bare)

    def act_at_random(self, seconds: float) -> Sample:
        """Physics of an easier kind: every world always acts, at random, from fresh resets."""
        return measure(self._random_episode, seconds)

    def _play_round(self, players: Players) -> int:
        game, generator = self._play.game, self._play.generator
        start_state = game.worlds.states.copy()
        fraction = self._run.config.generator.past_opponent_fraction
        plan = generator.opponents.freeze(0).plan(game.worlds.num_worlds, fraction, self._rng)
        snapshot = generator.snapshot()
        game.block_grippers(float(snapshot.success_rate))
        rollout = game.play_round(players, plan, partial(snapshot.choose_goals, plan, rng=self._rng))
        self.played.append(Round(start_state, rollout))
        return rollout.num_env_steps

    def _random_episode(self) -> int:
        self._worlds.reset(self._rng)
        shape = (RANDOM_STEPS, self._worlds.num_worlds, ACTION.size)
        for action in self._rng.uniform(-1.0, 1.0, shape).astype(np.float32):
            self._worlds.step(action)
        return shape[0] * shape[1]


def self_play(run: Run) -> LocalSelfPlay:
    """The method of a run of self-play in this process."""
    assert isinstance(run.method, LocalSelfPlay)
    return run.method


def players_of(run: Run) -> Players:
    """The newest policies of a run, and its past opponents."""
    weights, pool = self_play(run).learner.weights(), self_play(run).generator.opponents
    return Players(
        version=weights.version,
        alice=NumpyGaussianPolicy(weights.alice),
        bob=numpy_bob(weights.bob),
        past_alice=[NumpyGaussianPolicy(each) for each in pool.alice],
        past_bob=[numpy_bob(each) for each in pool.bob],
    )


def repeat_physics(worlds: WorldBatch, played: Round) -> int:
    """Step ``worlds`` through both turns of a round, to the very states in which Bob's turns ended.

    It returns the env steps made, as many as the round's.
    """
    alice, bob = played.rollout.alice, played.rollout.bob
    worlds.restore(played.start_state)
    for action in alice.action[alice.active.any(axis=1)]:
        worlds.step(action)
    worlds.restore(played.rollout.records.start_state)
    for action, active in zip(bob.action, bob.active, strict=True):
        playing = np.flatnonzero(active)
        if playing.size:
            worlds.step(action[playing], playing)
    return int(alice.active.sum() + bob.active.sum())
