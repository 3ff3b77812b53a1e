"""The choice of Bob's goals in a rollout worker, from a snapshot of what the task generator knows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.base.tensors import join_parts, split_parts
from service.base.types import Array, Arrays, BoolArray, IntArray, StateArray
from service.config import WorldConfig
from service.config.self_play import GOAL_SOURCES, SelfPlayConfig
from service.envs.observations import distances, each_object
from service.envs.overlap import inside_obstacles
from service.envs.sampling import are_apart, sample_goals
from service.envs.state_layout import places_at
from service.generator.bins import AIR_ABOVE_REST_M, GoalCells, TaskBins, highest, in_air
from service.generator.opponents import RoundPlan
from service.generator.ring import Rows, join_rows
from service.generator.sources import NUM_DRAWN, CheckedSource
from service.generator.validity import Verdict

LEARNABILITY_FLOOR = 0.01
"""Added to p (1 - p), which is at most 1/4, so solved and hopeless tasks stay drawable and measured."""
MIN_REPLAY_GOALS = 64
"""Goals the buffer must hold before any is replayed: fewer would be played over and over."""
_ARRAYS = ("learnability", "novelty", "novelty_of_arrangements", "success_rate", "coverage", "near_reached")


@dataclass(frozen=True, slots=True)
class GoalChoice:
    """The goals Bob plays in a round of N worlds, and where both he and the object start."""

    goal: StateArray
    """(N, 3 K) metres; where not ``played`` it is Alice's proposal as it came."""
    start_state: StateArray
    """(N, S) full physics state."""
    start_position: StateArray
    """(N, 3 K) positions of the objects there, metres."""
    replayed: BoolArray
    """(N,) the goal is one of the goal source, not this round's Alice's; one that was hers before has its own start."""
    from_reset: BoolArray
    """(N,) the start is that of a game."""
    played: BoolArray
    """(N,) there is a goal for Bob to play."""
    novelty: StateArray
    """(N,) ``GeneratorSnapshot.novelty`` of the cell of Alice's proposal, or of its arrangement, whichever is more, in
    [0, 1]; 0 where it is not valid."""


@dataclass(frozen=True, slots=True)
class _Tasks:
    """Tasks that Bob may get instead of Alice's: goals and starts."""

    rows: Rows
    """(M,) ``goal``, ``start_state`` and ``start_position``."""
    weight: StateArray
    """(M,)."""
    num_others: int
    """Those behind so many begin where a game does."""

    def give(self, choice: GoalChoice, worlds: IntArray, rng: np.random.Generator) -> None:
        """Give each of ``worlds`` one of them."""
        drawn = rng.choice(len(self.weight), size=len(worlds), p=self.weight / self.weight.sum())
        choice.from_reset[worlds] = drawn >= self.num_others
        for name, column in self.rows.items():
            getattr(choice, name)[worlds] = column[drawn]


@dataclass(frozen=True, slots=True)
class GeneratorSnapshot:
    """All that the choice of goals needs, as it was after some iteration: plain arrays, read only.

    It comes with the weights, so a worker that has both asks for nothing in the middle of a round.
    """

    config: SelfPlayConfig
    cells: GoalCells
    tasks: TaskBins
    buffer: Rows
    """(M,) ``goal`` of the replay buffer, and ``start_state`` and ``start_position`` from which it was proposed."""
    starts: Rows
    """``start_state`` and ``start_position`` of games."""
    held_starts: Rows
    """The same of later rounds in which the gripper holds the object."""
    learnability: StateArray
    """(task bins,) p (1 - p) of tasks."""
    novelty: StateArray
    """(cells,) how rare proposals there are, times the share of cells in which none was ever made."""
    novelty_of_arrangements: StateArray
    """(arrangements,) how rare they are among proposals; none of one object. Whatever cells she has seen: she stacks
    long after she has been everywhere."""
    success_rate: StateArray
    """() mean over all cells, 0 where no goal was proposed or tried."""
    coverage: StateArray
    """() share of the cells in which a goal was ever proposed."""
    near_reached: BoolArray
    """(cells,) an object was brought there in a game, or to a cell beside it."""

    def choose_goals(
        self,
        plan: RoundPlan,
        start_state: StateArray,
        start_position: StateArray,
        round_index: IntArray,
        proposal: StateArray,
        verdict: NDArray[np.int8],
        *,
        rng: np.random.Generator,
    ) -> GoalChoice:
        """Choose what Bob plays: Alice's valid goals, or others where the configuration says so.

        Others are her earlier ones, replayed, or those of another ``goal_source``, which count as replayed, too.

        Replayed goals go to the current Bob only: a past Bob's turns only show how hard Alice's goals are.

        Args:
            plan: who plays.
            start_state: (N, S) full physics state of this round's start.
            start_position: (N, 3 K) positions of the objects there, metres.
            round_index: (N,) 0 where it is the start of a game.
            proposal: (N, 3 K) positions at the end of Alice's turn, metres; those of a start of what she did not move.
            verdict: (N,) ``Verdict`` of the proposal.
            rng: source of the choice.
        """
        valid: BoolArray = verdict == Verdict.VALID
        replayed, tasks = self._choose_replayed(valid, plan.bob_past, rng), None
        if replayed.any():
            tasks = self._other_tasks(start_state, start_position, rng)
            replayed &= tasks.weight.any()
        starts = start_state.copy(), start_position.copy()
        from_reset = (round_index == 0) & ~replayed
        novelty = np.zeros(len(proposal))
        novelty[valid] = self._novelty(proposal[valid], start_position[valid])
        choice = GoalChoice(proposal.copy(), *starts, replayed, from_reset, valid | replayed, novelty)
        if tasks is not None and replayed.any():
            tasks.give(choice, np.flatnonzero(replayed), rng)
        return choice

    @property
    def _own_source(self) -> CheckedSource:
        rates = float(self.coverage), float(self.success_rate)
        return CheckedSource(self.config, *rates, self._near)

    def _near(self, goal: StateArray) -> BoolArray:
        """(M,) whether all objects of (M, 3 K) goals lie in cells that are ``near_reached``."""
        near: BoolArray = np.all(self.near_reached[self.cells.index(goal)], axis=1)
        return near

    def _novelty(self, proposal: StateArray, start: StateArray) -> StateArray:
        """(M,) novelty of (M, 3 K) proposals from (M, 3 K) starts."""
        novelty: StateArray = self.novelty[self.cells.of_moved(proposal, start)]
        if not self.novelty_of_arrangements.size:
            return novelty
        return np.maximum(novelty, self.novelty_of_arrangements[self.tasks.arrangements(proposal, start)])

    def state(self) -> Arrays:
        """All arrays by flat names."""
        arrays: Arrays = {name: array for name in _ARRAYS if (array := getattr(self, name)).size}  # no empty ones
        return arrays | join_parts({"buffer": self.buffer, "starts": self.starts, "held_starts": self.held_starts})

    def with_state(self, state: Mapping[str, Array]) -> GeneratorSnapshot:
        """A snapshot with the arrays that ``state`` gave, and all else from this one."""
        parts = split_parts(state)
        arrays: dict[str, Any] = {name: state[name] for name in _ARRAYS if name in state}
        return replace(self, **arrays, buffer=parts["buffer"], starts=parts["starts"], held_starts=parts["held_starts"])

    def _choose_replayed(self, valid: BoolArray, bob_past: BoolArray, rng: np.random.Generator) -> BoolArray:
        """(N,) worlds whose goal comes from the goal source."""
        config = self.config.generator
        if config.goal_source == "alice" and len(self.buffer["goal"]) < MIN_REPLAY_GOALS:
            return np.zeros(len(valid), dtype=np.bool_)
        # While much of the workspace is new to her, what she proposes is worth more than what she once did.
        replaced: BoolArray = valid & (rng.random(len(valid)) < config.replay_fraction * self.coverage)
        filled: BoolArray = ~valid & config.replay_invalid
        return (replaced | filled) & ~bob_past

    def _other_tasks(self, start_state: StateArray, start_position: StateArray, rng: np.random.Generator) -> _Tasks:
        """Draw tasks besides those that Alice has just set: other goals, and the same again from starts of games.

        Whatever is asked of Bob downstream begins with a reset, but Alice reaches far goals over several rounds, so few
        of her own do. All compete by learnability: far goals from a reset wait until Bob is ready.
        """
        config = self.config.generator
        if config.goal_source == "alice":
            rows = self.buffer
            goal = rows["goal"]
        else:
            goal, starts = self._new_goals(rng), {"start_state": start_state, "start_position": start_position}
            if len(self.held_starts["start_position"]):
                # Every second start is in the hand: he learns to carry long before he learns to grasp.
                starts = join_rows([starts, _drawn(self.held_starts, len(start_state), rng)])
            rows = self._begun(goal, starts, rng)
        if config.replay_from_reset and len(self.starts["start_position"]):
            rows = join_rows([rows, self._begun(goal, self.starts, rng)])
        return _Tasks(rows, self._weight(**rows) * self._is_task(**rows), len(goal))

    def _begun(self, goal: StateArray, starts: Rows, rng: np.random.Generator) -> Rows:
        """Give each of (M, 3 K) goals one of the starts; of several objects often all but one are to stay."""
        rows = {"goal": goal} | _drawn(starts, len(goal), rng)
        if self.cells.num_objects > 1:
            rows["goal"] = _one_stays(goal, rows["start_position"], self.config.world, rng)
        return rows

    def _new_goals(self, rng: np.random.Generator) -> StateArray:
        """(M, 3 K) goals that Alice did not propose, metres."""
        source = self.config.generator.goal_source
        if source not in GOAL_SOURCES:
            return self._own_source.goals(rng)
        goal = sample_goals("mixed", rng, NUM_DRAWN, self.config.world, self.config.game.success_distance_m)
        return goal[self._near(goal)] if source == "reached" else goal

    def _weight(self, goal: StateArray, start_state: StateArray, start_position: StateArray) -> StateArray:
        """(M,) weights of tasks: what Bob can learn from each, all alike, or what a user's source says."""
        source = self.config.generator.goal_source
        if source == "uniform":
            return np.ones(len(goal))
        weight: StateArray = self.learnability[self.tasks.index(goal, start_position, start_state)]
        if source in GOAL_SOURCES:
            return weight + LEARNABILITY_FLOOR
        return self._own_source.weights(goal, start_position, weight)

    def _is_task(self, goal: StateArray, start_state: StateArray, start_position: StateArray) -> BoolArray:
        """(M,) whether an object has to be moved, and can be: a closed gripper lifts nothing, and things take room."""
        world = self.config.world
        far: BoolArray = distances(goal, start_position).max(axis=1) > self.config.game.success_distance_m
        if world.obstacles:
            far &= ~inside_obstacles(goal, places_at(start_state, self.tasks.obstacles), world)
        return far & ~(self.tasks.blocked(start_state) & in_air(highest(goal, world), world.rest_height_m))


def _one_stays(goal: StateArray, start: StateArray, world: WorldConfig, rng: np.random.Generator) -> StateArray:
    """(M, 3 K) goals clear of each other: in every second of those given all objects but one stay where they start.

    What the gripper holds does not stay: nothing holds it while another one is moved. Where the others would be in the
    way, the goal is as given.
    """
    num = world.num_objects
    moved = rng.integers(2 * num, size=len(goal))
    # What rests on another object does not stay, either.
    raised = each_object(start)[:, :, 2] - world.rest_heights_m
    if world.randomisation.table_height_m is not None:  # the table's own height does not count
        raised = raised - raised.min(axis=1, keepdims=True)
    lifted = raised > AIR_ABOVE_REST_M / 2
    moved = np.where((moved < num) & lifted.any(axis=1), lifted.argmax(axis=1), moved)
    stays = (moved[:, None] < num) & (moved[:, None] != np.arange(num))
    kept = np.where(np.repeat(stays, 3, axis=1), start, goal)
    return np.where(are_apart(kept, world)[:, None], kept, goal)


def _drawn(rows: Rows, num: int, rng: np.random.Generator) -> Rows:
    """Draw ``num`` of the rows."""
    drawn = rng.integers(len(next(iter(rows.values()))), size=num)
    return {name: column[drawn] for name, column in rows.items()}
