"""The task generator: the choice of opponents and goals for a round, their outcomes, and the end of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.config import Config
from service.envs.state_layout import StateLayout
from service.generator.difficulty import (
    DISTANCE_EDGES_M,
    HEIGHT_NAMES,
    DifficultyGrid,
    SuccessCounts,
    distance_bins,
    height_bins,
    in_air,
)
from service.generator.opponents import OpponentPool, RoundPlan
from service.generator.records import GoalRecords, alice_metrics, bob_metrics, mean, without_nan
from service.generator.ring import Ring
from service.generator.stopping import StopCriterion
from service.generator.validity import Verdict
from service.io.tensors import join_parts, split_parts
from service.types import Array, Arrays, BoolArray, IntArray, Metrics, StateArray

LEARNABILITY_FLOOR = 0.01
"""Added to p (1 - p), which is at most 1/4, so goals of a solved or hopeless cell stay drawable and measured."""
NUM_STARTS = 1024
"""Starts of games kept for ``replay_from_reset``."""
MIN_REPLAY_GOALS = 64
"""Goals the buffer must hold before any is replayed: fewer would be played over and over."""
NUM_DISTANCE_BINS = len(DISTANCE_EDGES_M) + 1
NUM_TASK_BINS = len(HEIGHT_NAMES) * NUM_DISTANCE_BINS


@dataclass(frozen=True, slots=True)
class GoalChoice:
    """The goals Bob plays in a round of N worlds, and where both he and the object start."""

    goal: StateArray
    """(N, 3) metres; where not ``played`` it is Alice's proposal as it came."""
    start_state: StateArray
    """(N, S) full physics state."""
    start_position: StateArray
    """(N, 3) object position there, metres."""
    replayed: BoolArray
    """(N,) the goal and its start come from the buffer, not from this round's Alice."""
    from_reset: BoolArray
    """(N,) the start is that of a game."""
    played: BoolArray
    """(N,) there is a goal for Bob to play."""


class TaskGenerator:
    """Goals, opponents, difficulty and the stop criterion of one run.

    In call order: ``plan``, ``choose_goals``, ``record``, ``add_opponents`` if ``snapshot_due``, ``should_stop``; one
    ``record`` is one iteration.
    It draws only from the random generators it is given, so ``state`` and theirs are all that an exact resume needs.
    """

    grid: DifficultyGrid
    """Bob's success over goal cells."""
    buffer: Ring
    """Earlier valid goals and the states they were proposed from, drawn by learnability (Rutherford et al. 2024)."""
    starts: Ring
    """States right after a reset."""
    from_reset: SuccessCounts
    """Bob's success from resets, by the goal's height and distance; those with a blocked gripper apart. They are harder
    than what starts where Alice left off."""
    opponents: OpponentPool
    """Past versions of both players."""

    def __init__(self, config: Config, layout: StateLayout) -> None:
        self._layout = layout
        self._config = config.generator
        self._success_distance_m = config.game.success_distance_m
        self._rest_height_m = config.world.object_size_m / 2
        self._some_blocked = config.game.blocked_gripper_fraction > 0.0
        self.grid = DifficultyGrid(config.world, config.generator.cell_size_m)
        columns = {"start_state": layout.size, "start_position": 3}
        num_cells = self.grid.seen.size if config.generator.replay_over_cells else 1
        self.buffer = Ring(config.generator.replay_buffer_size, num_cells, **columns, goal=3)
        self.starts = Ring(NUM_STARTS, **columns)
        self.opponents = OpponentPool(config.generator.opponent_pool_size)
        self.from_reset = SuccessCounts(NUM_TASK_BINS * (1 + self._some_blocked))
        self._stop = StopCriterion(config.generator)
        self._parts: dict[str, DifficultyGrid | Ring | SuccessCounts | OpponentPool | StopCriterion] = {
            "grid": self.grid,
            "buffer": self.buffer,
            "starts": self.starts,
            "from_reset": self.from_reset,
            "opponents": self.opponents,
            "stop": self._stop,
        }

    def plan(self, num_worlds: int, rng: np.random.Generator) -> RoundPlan:
        """Choose the players of the next round; all current while there are no past versions."""
        return self.opponents.plan(num_worlds, self._config.past_opponent_fraction, rng)

    def choose_goals(
        self,
        plan: RoundPlan,
        start_state: StateArray,
        start_position: StateArray,
        round_index: IntArray,
        proposal: StateArray,
        verdict: NDArray[np.int8],
        rng: np.random.Generator,
    ) -> GoalChoice:
        """Choose what Bob plays: Alice's valid goals, or replayed ones where the configuration says so.

        Replayed goals go to the current Bob only: nobody learns from a past Bob, he shows how hard Alice's goals are.

        Args:
            plan: who plays.
            start_state: (N, S) full physics state of this round's start.
            start_position: (N, 3) object position there, metres.
            round_index: (N,) 0 where it is the start of a game.
            proposal: (N, 3) object position at the end of Alice's turn, metres.
            verdict: (N,) ``Verdict`` of the proposal.
            rng: source of the choice.
        """
        reset = round_index == 0
        self.starts.add(start_state=start_state[reset], start_position=start_position[reset])
        valid: BoolArray = verdict == Verdict.VALID
        replayed = self._choose_replayed(valid, plan.bob_past, rng)
        starts = start_state.copy(), start_position.copy()
        choice = GoalChoice(proposal.copy(), *starts, replayed, reset & ~replayed, valid | replayed)
        if replayed.any():
            self._replay(choice, np.flatnonzero(replayed), rng)
        return choice

    def record(self, records: GoalRecords) -> Metrics:
        """Take in the outcomes of one iteration's goals.

        Difficulty follows every try of the current Bob; the buffer takes the valid goals that Bob played straight from
        Alice; a cell is new when a valid proposal, a past Alice's included, is the first in it.

        Returns:
            ``alice/*``, ``bob/*`` and ``generator/*`` metrics; a rate over no cases is left out.
        """
        num_new_cells = self.grid.mark_seen(records.proposal[records.verdict == Verdict.VALID])
        tried = records.played & ~records.bob_past
        reset = tried & records.from_reset
        tasks = records.goal[reset], records.start_position[reset], self._blocked(records.start_state[reset])
        self.from_reset.record(self._task_bins(*tasks), records.solved[reset])
        as_proposed = tried & ~(records.replayed & records.from_reset)
        self.grid.record(records.goal[as_proposed], records.solved[as_proposed])
        own = records.own
        goal = records.goal[own]
        self.buffer.add(
            self.grid.cell_index(goal) if self._config.replay_over_cells else None,
            start_state=records.start_state[own],
            start_position=records.start_position[own],
            goal=goal,
        )
        solved = records.solved[records.current]
        self._stop.record(num_new_cells, len(solved), int(solved.sum()))
        return (
            alice_metrics(records, self._rest_height_m)
            | bob_metrics(records, self._rest_height_m)
            | without_nan(self._blocked_metrics(records, tried) | self._own_metrics(num_new_cells))
        )

    def snapshot_due(self, iteration: int) -> bool:
        """Whether the players of this iteration, counted from 0, join the pool; the untrained ones never do."""
        return iteration > 0 and iteration % self._config.opponent_interval == 0

    def add_opponents(self, alice: Mapping[str, Array], bob: Mapping[str, Array]) -> None:
        """Add both players' parameters to the pool, copied; the oldest are dropped from a full pool."""
        self.opponents.add(alice, bob)

    def should_stop(self) -> bool:
        """Whether, over ``novelty_window`` iterations, Alice found no new goal cell and Bob solved her goals."""
        return self._stop.should_stop()

    def state(self) -> Arrays:
        """Everything an exact resume needs, copied: flat named arrays."""
        return join_parts({name: part.state() for name, part in self._parts.items()})

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave.

        Raises:
            ConfigError: an array is missing, or of another configuration.
        """
        states = split_parts(state)
        for name, part in self._parts.items():
            part.load_state(states.get(name, {}))

    def _choose_replayed(self, valid: BoolArray, bob_past: BoolArray, rng: np.random.Generator) -> BoolArray:
        """(N,) worlds whose goal comes from the buffer."""
        if len(self.buffer) < MIN_REPLAY_GOALS:
            return np.zeros(len(valid), dtype=np.bool_)
        replaced: BoolArray = valid & (rng.random(len(valid)) < self._config.replay_fraction)
        filled: BoolArray = ~valid & self._config.replay_invalid
        return (replaced | filled) & ~bob_past

    def _replay(self, choice: GoalChoice, worlds: IntArray, rng: np.random.Generator) -> None:
        """Give ``worlds`` earlier goals, from the start each was proposed from or from that of some game.

        Whatever is asked of Bob downstream begins with a reset, but Alice reaches far goals over several rounds, so few
        of her own do. Both kinds of task compete by learnability: far goals from a reset wait until Bob is ready.
        """
        # Each goal of the buffer is a candidate from its own start and, behind all of these, from the start of a game.
        goal = self.buffer["goal"]
        tasks = {name: self.buffer[name] for name in ("start_state", "start_position")}
        share = self.buffer.part_share()
        weight = (self.grid.learnability(goal) + LEARNABILITY_FLOOR) * share
        if self._config.replay_from_reset and len(self.starts):
            start = self.starts.sample(rng, len(goal))
            position = start["start_position"]
            blocked = self._blocked(start["start_state"])
            far = np.linalg.norm(goal - position, axis=1) > self._success_distance_m  # nearer ones are no task
            possible = ~(blocked & in_air(goal, self._rest_height_m))  # a closed gripper lifts nothing
            learnability = self.from_reset.learnability()[self._task_bins(goal, position, blocked)]
            weight = np.concatenate([weight, np.where(far & possible, learnability + LEARNABILITY_FLOOR, 0.0) * share])
            tasks = {name: np.concatenate([rows, start[name]]) for name, rows in tasks.items()}
        drawn = rng.choice(len(weight), size=len(worlds), p=weight / weight.sum())
        choice.goal[worlds] = goal[drawn % len(goal)]
        choice.from_reset[worlds] = drawn >= len(goal)
        choice.start_state[worlds] = tasks["start_state"][drawn]
        choice.start_position[worlds] = tasks["start_position"][drawn]

    def _task_bins(self, goals: StateArray, starts: StateArray, blocked: BoolArray) -> IntArray:
        """(M,) bin of tasks by the goal's height, its distance from the object's start, and (M,) blocked grippers."""
        bins = height_bins(goals, self._rest_height_m) * NUM_DISTANCE_BINS + distance_bins(goals, starts)
        return bins + blocked * NUM_TASK_BINS

    def _blocked(self, states: StateArray) -> BoolArray:
        """(M,) whether the gripper of (M, S) states is blocked; none is where states have no such flag."""
        blocked: BoolArray = np.any(states[:, self._layout["gripper_blocked"]] > 0.0, axis=1)
        return blocked

    def _blocked_metrics(self, records: GoalRecords, tried: BoolArray) -> Metrics:
        if not self._some_blocked:
            return {}
        blocked = self._blocked(records.start_state)
        valid = records.verdict[blocked & ~records.alice_past & ~records.replayed] == Verdict.VALID
        return {
            "alice/valid_fraction_blocked": mean(valid),
            "bob/success_rate_blocked": mean(records.solved[tried & blocked]),
        }

    def _own_metrics(self, num_new_cells: int) -> Metrics:
        return {
            "generator/num_cells_seen": float(self.grid.num_cells_seen),
            "generator/new_cells": float(num_new_cells),
            "generator/iterations_without_new_cell": float(self._stop.num_iterations_without_new_cell),
            "generator/buffer_size": float(len(self.buffer)),
            "generator/mean_learnability": self.grid.mean_learnability(),
        }
