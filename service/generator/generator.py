"""The task generator: what became of goals, past opponents, difficulty, and the end of a run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from service.base.tensors import join_parts, split_parts
from service.base.types import Array, Arrays, Metrics
from service.config.self_play import GeneratorConfig, SelfPlayConfig
from service.envs.state_layout import StateLayout
from service.generator.bins import GoalCells, TaskBins
from service.generator.difficulty import DifficultyGrid, SuccessCounts, novelty
from service.generator.opponents import Opponents
from service.generator.records import GoalSummary, height_p90_m, means
from service.generator.ring import Ring
from service.generator.snapshot import GeneratorSnapshot

NUM_STARTS = 1024
"""Starts of either kind that are kept: of games, for ``replay_from_reset``, and in the hand."""
MIN_NUM_GOALS = 100
"""Goals the window must hold before Bob's success rate says anything: its 95 % interval is then below +-10 points."""


class StopCriterion:
    """The paper's stop criterion over a window of iterations: Alice finds nothing new, and Bob solves all he plays."""

    def __init__(self, config: GeneratorConfig) -> None:
        self._stop_success_rate = config.stop_success_rate
        self._window = np.zeros((config.novelty_window, 2), dtype=np.int64)  # tries and successes of an iteration
        self._num_iterations = 0
        self.num_iterations_without_new_cell = 0
        """Iterations since the last new goal cell."""

    def record(self, num_new_cells: int, num_tried: int, num_solved: int) -> None:
        """Add one iteration: new goal cells, and the present Bob's tries and successes, all of them."""
        self._window[self._num_iterations % len(self._window)] = num_tried, num_solved
        self._num_iterations += 1
        self.num_iterations_without_new_cell = 0 if num_new_cells else self.num_iterations_without_new_cell + 1

    def should_stop(self) -> bool:
        """Whether, over a whole window, no cell was new and Bob solved enough of at least ``MIN_NUM_GOALS`` goals."""
        num_tried, num_solved = self._window.sum(axis=0)
        saturated = self.num_iterations_without_new_cell >= len(self._window)
        return bool(saturated and num_tried >= MIN_NUM_GOALS and num_solved >= self._stop_success_rate * num_tried)

    def state(self) -> Arrays:
        """Everything, copied."""
        counters = np.array([self._num_iterations, self.num_iterations_without_new_cell])
        return {"window": self._window.copy(), "counters": counters}

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave."""
        self._window = np.array(state["window"])
        self._num_iterations, self.num_iterations_without_new_cell = map(int, state["counters"])


class TaskGenerator:
    """What became of a run's goals, its past opponents, and the stop criterion.

    In call order: ``record``, ``add_opponents``, ``snapshot``, ``should_stop``; one ``record`` is one iteration.
    Nothing here is random.
    """

    def __init__(self, config: SelfPlayConfig, layout: StateLayout) -> None:
        self._config = config
        self.cells = GoalCells(config.world, config.generator.cell_size_m)
        self.tasks = TaskBins(config, layout)
        self.grid = DifficultyGrid(self.cells)
        """Bob's success over goal cells."""
        num = 3 * config.world.num_objects
        columns = {"start_state": layout.size, "start_position": num}
        self.buffer = Ring(config.generator.replay_buffer_size, **columns, goal=num)
        """Earlier valid goals and the states they came from, drawn by learnability (Rutherford et al. 2024)."""
        self.starts = Ring(NUM_STARTS, **columns)
        """States right after a reset."""
        self.held_starts = Ring(NUM_STARTS, **columns)
        """States at the start of a later round in which the gripper holds the object."""
        self.opponents = Opponents(0)
        """Past versions of both players."""
        self.difficulty = SuccessCounts(len(self.tasks))
        """Bob's success at tasks, by their bins."""
        self._stop = StopCriterion(config.generator)
        self._parts: dict[str, DifficultyGrid | Ring | SuccessCounts | StopCriterion] = {
            "grid": self.grid,
            "buffer": self.buffer,
            "starts": self.starts,
            "held_starts": self.held_starts,
            "difficulty": self.difficulty,
            "stop": self._stop,
        }

    def snapshot(self) -> GeneratorSnapshot:
        """All that rollout workers need to choose goals in the next round; a copy."""
        coverage = self.grid.seen_by_object.mean(axis=1)  # what is known of one object makes another no less new
        return GeneratorSnapshot(
            config=self._config,
            cells=self.cells,
            tasks=self.tasks,
            buffer=self.buffer.rows(),
            starts=self.starts.rows(),
            held_starts=self.held_starts.rows(),
            learnability=self.difficulty.learnability(),
            novelty=novelty(self.grid.proposals) * np.repeat(1.0 - coverage, len(self.cells) // len(coverage)),
            novelty_of_arrangements=novelty(self.grid.arranged),
            success_rate=np.array(self.grid.mean_success_rate()),
            coverage=np.array(self.grid.seen.mean()),
            near_reached=self.grid.near_reached(),
        )

    def record(self, summary: GoalSummary) -> Metrics:
        """Take in the outcomes of one iteration's goals.

        Args:
            summary: of all its rounds.

        Returns:
            ``alice/*``, ``bob/*`` and ``generator/*`` metrics; a rate over no cases is left out.
        """
        self.starts.add(**summary.starts)
        self.held_starts.add(**summary.held_starts)
        num_new_cells = self.grid.record(
            summary.proposed, summary.reached, summary.tries, summary.successes, summary.arranged
        )
        self.difficulty.record(summary.task_tries, summary.task_successes)
        if self._config.generator.goal_source == "alice":  # no other source draws from it
            self.buffer.add(**summary.goals)
        self._stop.record(num_new_cells, int(summary.task_tries.sum()), int(summary.task_successes.sum()))
        metrics = {
            **means(summary.metrics),
            "alice/goal_height_p90_m": height_p90_m(summary.heights),
            "generator/num_cells_seen": float(self.grid.num_cells_seen),
            "generator/num_cells_reached": float(np.count_nonzero(self.grid.reached)),
            "generator/new_cells": float(num_new_cells),
            "generator/iterations_without_new_cell": float(self._stop.num_iterations_without_new_cell),
            "generator/buffer_size": float(len(self.buffer)),
            "generator/mean_learnability": self.grid.mean_learnability(),
            "generator/mean_success_rate": self.grid.mean_success_rate(),
        }
        if self.cells.num_objects > 1:
            for number, seen in enumerate(self.grid.seen_by_object, start=1):
                metrics[f"generator/num_cells_seen_object_{number}"] = float(np.count_nonzero(seen))
        return {name: value for name, value in metrics.items() if not np.isnan(value)}

    def add_opponents(self, iteration: int, alice: Mapping[str, Array], bob: Mapping[str, Array]) -> None:
        """Add the parameters of some iterations' players to the past ones, of which the oldest may go.

        Iterations are counted from 0; the untrained players of the first never join.
        """
        config = self._config.generator
        if iteration > 0 and iteration % config.opponent_interval == 0:
            # The number of the iteration is a version that is the same whichever process records it.
            self.opponents = self.opponents.joined_by(alice, bob, iteration, config.opponent_pool_size)

    def should_stop(self) -> bool:
        """Whether, over ``novelty_window`` iterations, Alice found no new goal cell and Bob solved all he played."""
        return self._stop.should_stop()

    def state(self) -> Arrays:
        """Everything an exact resume needs: flat named arrays."""
        parts = {name: part.state() for name, part in self._parts.items()}
        return join_parts(parts | {"opponents": self.opponents.state()})

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Take over what ``state`` gave."""
        states = split_parts(state)
        for name, part in self._parts.items():
            part.load_state(states[name])
        self.opponents = Opponents.from_state(0, states.get("opponents", {}))
