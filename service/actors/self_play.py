"""Asymmetric self-play: one round of Alice, then Bob, on a batch of worlds.

Alice acts from s0 for a number of steps, fixed or drawn; where the objects then are becomes the goal. The worlds go
back to s0, and Bob acts until he has held the objects there or his time is over. The next round of the game starts
where Alice ended, so games reach grasped objects by themselves; an invalid goal ends the game (OpenAI 2021, section 3).
Without Alice, a control, Bob plays goals of the task generator, and the next round starts where he ended.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from service.actors.rollout import Demonstrations, Rollout, Turns, join_demonstrations
from service.base.types import Arrays, BoolArray, FloatArray, IntArray, Metrics, StateArray
from service.config.self_play import SelfPlayConfig
from service.envs.batch import WorldBatch
from service.envs.observations import ACTION, bob_observation, distances, each_object
from service.generator.bins import GoalCells
from service.generator.opponents import CURRENT, RoundPlan
from service.generator.records import GoalRecords
from service.generator.ring import Rows
from service.generator.snapshot import GeneratorSnapshot, GoalChoice
from service.generator.validity import Verdict, classify_goal, in_workspace, proposed

_HINDSIGHT_STRIDE = 4
"""One in so many steps of Bob's failures is a demonstration where Alice gives none to measure them by: about as many as
in self-play."""


class StochasticPolicy(Protocol):
    """A policy whose actions are sampled, such as those of ``policies.numpy_policy``."""

    def act(self, observation: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """(N, O) observations to sampled actions (N, A) and log-probabilities (N,)."""


StateObserver = Callable[[StateArray], None]
"""Called with the (N, S) states at the start of a turn and after each of its steps; it must copy what it keeps."""


@dataclass(frozen=True, slots=True)
class Players:
    """The policies that play a round: the current ones of one version, and past ones by index."""

    version: int
    alice: StochasticPolicy
    bob: StochasticPolicy
    past_alice: Sequence[StochasticPolicy] = ()
    past_bob: Sequence[StochasticPolicy] = ()


class SelfPlay:
    """Rounds of self-play on N worlds, one rollout each.

    Everything that later rounds depend on is in ``state``: the worlds and how far each game is; its owner saves
    the random generator.

    Args:
        config: the run.
        rng: drives resets and both players' sampling.
        actor, incarnation: first parts of every rollout's id.
        num_threads: native threads for physics; 0 for one per core.
    """

    def __init__(
        self,
        config: SelfPlayConfig,
        rng: np.random.Generator,
        *,
        actor: int = 0,
        incarnation: int = 0,
        num_threads: int = 0,
    ) -> None:
        self.config = config
        self.worlds = WorldBatch(
            config.world,
            config.game.num_worlds,
            num_threads=num_threads,
            blocked_fraction=config.game.blocked_gripper_fraction,
        )
        self._rng = rng
        self.incarnation = incarnation
        self._actor, self._sequence = actor, 0
        self._round_index: IntArray = np.zeros(config.game.num_worlds, dtype=np.int64)
        self.cells = GoalCells(config.world, config.generator.cell_size_m)
        self.reached: IntArray = np.zeros(len(self.cells), dtype=np.int64)
        """(cells,) steps of the last round after which an object was there."""
        self.block_grippers(0.0)
        self.worlds.reset(rng)

    def close(self) -> None:
        """Stop the worlds' threads."""
        self.worlds.close()

    def block_grippers(self, success_rate: float) -> None:
        """Say how good Bob is over all goal cells: on that depends whether new games may have a blocked gripper."""
        game = self.config.game
        may_be = success_rate >= game.blocked_gripper_min_success
        self.worlds.blocked_fraction = game.blocked_gripper_fraction if may_be else 0.0

    def start_over(self) -> None:
        """End every game: the next round begins new ones."""
        self.worlds.reset(self._rng)
        self._round_index[:] = 0

    def round_starts(self) -> Rows:
        """(N,) ``start_state`` and ``start_position`` of the next round; copies."""
        return {"start_state": self.worlds.states.copy(), "start_position": self.worlds.object_position.copy()}

    def play_round(
        self, players: Players, plan: RoundPlan, snapshot: GeneratorSnapshot, *, observe: StateObserver | None = None
    ) -> Rollout:
        """Play one round in every world.

        Args:
            players: the policies.
            plan: which worlds use a past Alice or Bob.
            snapshot: chooses Bob's goals, between the two turns.
            observe: records the round, Alice's turn and then Bob's; it changes nothing in the rollout.
        """
        game, worlds = self.config.game, self.worlds
        self.reached = np.zeros(len(self.cells), dtype=np.int64)
        start_state, start_position = worlds.states.copy(), worlds.object_position.copy()
        play_alice = self._play_alice if game.alice_plays else self._leave_alice_out
        alice, contacts, diverged = play_alice(players, plan, observe)
        end_state, end_position = worlds.states.copy(), worlds.object_position.copy()
        verdict = classify_goal(start_position, end_position, self.config.world.workspace, game.success_distance_m)
        verdict[diverged] = Verdict.FALLEN
        proposal = proposed(start_position, end_position, game.success_distance_m)
        choice = snapshot.choose_goals(
            plan,
            start_state,
            start_position,
            self._round_index,
            proposal,
            verdict,
            rng=self._rng,
        )

        worlds.restore(choice.start_state)
        bob, solved, diverged = self._play_bob(players, plan, choice, observe)
        achieved = worlds.object_position.copy()
        played = choice.played & ~diverged  # a turn in which the physics diverged says nothing about either player
        bob.learn[diverged] = False
        if game.alice_plays:
            self._reward_alice(alice, verdict, played & ~choice.replayed, solved, choice.novelty)
        records = GoalRecords(
            start_state=choice.start_state,
            start_position=choice.start_position,
            goal=choice.goal,
            proposal=proposal,
            verdict=verdict,
            replayed=choice.replayed,
            from_reset=choice.from_reset,
            played=played,
            solved=solved,
            num_bob_steps=bob.active.sum(axis=0),
            alice_past=plan.alice_past,
            bob_past=plan.bob_past,
            round_index=self._round_index.copy(),
        )
        if game.alice_plays:
            self._continue_games(end_state, verdict == Verdict.VALID)
        else:
            inside = in_workspace(each_object(achieved), self.config.world.workspace).all(axis=1)
            self._continue_games(worlds.states.copy(), inside & ~diverged)
        num_bob_steps = int(bob.active.sum())
        rollout = Rollout(
            actor=self._actor,
            incarnation=self.incarnation,
            sequence=self._sequence,
            policy_version=players.version,
            alice=alice,
            bob=bob,
            demonstrations=self._demonstrations(alice, bob, records, achieved),
            records=records,
            num_env_steps=(num_env_steps := int(alice.active.sum()) + num_bob_steps),
            metrics=_contact_metrics(contacts) | {"bob/env_steps_fraction": num_bob_steps / max(num_env_steps, 1)},
            diverged=tuple(worlds.diverged),
        )
        worlds.diverged = []
        self._sequence += 1
        return rollout

    def _play_alice(
        self, players: Players, plan: RoundPlan, observe: StateObserver | None
    ) -> tuple[Turns, BoolArray, BoolArray]:
        """Alice's turns, without the reward of her goal; (N, 2 K) finger contacts; (N,) worlds that diverged."""
        game, worlds = self.config.game, self.worlds
        num_steps = int(self._rng.integers(game.alice_steps_min or game.alice_steps, game.alice_steps + 1))
        size = worlds.observed.full.size
        turns = _empty_turns(game.alice_steps, worlds.num_worlds, size, size, learn=~plan.alice_past)
        all_worlds = np.arange(worlds.num_worlds)
        contacts = np.zeros((worlds.num_worlds, 2 * self.config.world.num_objects), dtype=bool)
        diverged = np.zeros(worlds.num_worlds, dtype=bool)
        if observe:
            observe(worlds.states)
        for step in range(num_steps):
            observation = worlds.full(1.0 - (num_steps - step) / game.alice_steps)
            action, log_prob = _act(
                players.alice, players.past_alice, plan.alice_opponent, observation, all_worlds, self._rng
            )
            turns.observation[step], turns.action[step], turns.log_prob[step] = observation, action, log_prob
            diverged |= worlds.step(action[~diverged], np.flatnonzero(~diverged))
            if observe:
                observe(worlds.states)
            contacts |= worlds.contacts()
            self._count_reached(all_worlds[~diverged])
        turns.value_observation[:] = turns.observation
        turns.final_value_observation[:] = worlds.full(1.0)
        turns.active[:num_steps] = True
        turns.terminated[num_steps - 1] = True
        turns.learn[diverged] = False
        return turns, contacts, diverged

    def _leave_alice_out(
        self, players: Players, plan: RoundPlan, observe: StateObserver | None
    ) -> tuple[Turns, BoolArray, BoolArray]:
        """Turns without a step, as ``_play_alice`` gives them."""
        num = self.worlds.num_worlds
        no_world = np.zeros(num, dtype=bool)
        size = self.worlds.observed.full.size
        turns = _empty_turns(self.config.game.alice_steps, num, size, size, learn=no_world)
        return turns, np.zeros((num, 2 * self.config.world.num_objects), dtype=bool), no_world

    def _play_bob(
        self, players: Players, plan: RoundPlan, choice: GoalChoice, observe: StateObserver | None
    ) -> tuple[Turns, BoolArray, BoolArray]:
        """Bob's turns; (N,) solved; (N,) worlds whose physics diverged.

        A world's turn ends when its objects have been at their goals for ``bob_hold_steps`` steps in a row, its physics
        diverged, or its time is over, which is longer where several objects have to be moved. The others go on;
        ``playing`` holds their indices.
        """
        game, worlds = self.config.game, self.worlds
        num = worlds.num_worlds
        sizes = worlds.observed.bob.size, worlds.observed.bob_value.size
        most_steps = game.bob_steps * self.config.world.num_objects
        turns = _empty_turns(most_steps, num, *sizes, learn=choice.played & ~plan.bob_past)
        diverged = np.zeros(num, dtype=bool)
        num_held: IntArray = np.zeros(num, dtype=np.int64)
        margin_m = game.bob_margin_m if players.version >= game.bob_margin_after_updates else 0.0
        reach_m = game.success_distance_m - margin_m
        playing = np.flatnonzero(choice.played)
        there = self._at_goals(choice.goal, reach_m)
        # What lies at its goal counts as there, unless there is nothing else to do.
        there &= ~np.all(there, axis=1, keepdims=True)
        num_steps = game.bob_steps * np.count_nonzero(~there, axis=1)
        if observe:
            observe(worlds.states)
        for step in range(most_steps):
            if not playing.size:
                break
            observation = bob_observation(worlds.positions()[playing], choice.goal[playing])
            action, log_prob = _act(players.bob, players.past_bob, plan.bob_opponent, observation, playing, self._rng)
            turns.observation[step, playing], turns.action[step, playing] = observation, action
            turns.value_observation[step, playing] = worlds.bob_value(choice.goal)[playing]
            turns.log_prob[step, playing], turns.active[step, playing] = log_prob, True
            diverged |= worlds.step(action, playing)
            if observe:
                observe(worlds.states)
            self._count_reached(playing[~diverged[playing]])
            reached = self._at_goals(choice.goal, reach_m)
            # Reaching a goal earns the reward and leaving it takes the reward back; ``there`` is the step before.
            turns.reward[step, playing] = (self._worth(reached) - self._worth(there))[playing]
            there[playing] = reached[playing]
            num_held = np.where(reached.all(axis=1), num_held + 1, 0)
            over = num_held >= game.bob_hold_steps
            turns.terminated[step, playing] = over[playing]
            playing = playing[~(over | diverged | (num_steps == step + 1))[playing]]
        turns.final_value_observation[:] = worlds.bob_value(choice.goal)
        solved: BoolArray = np.all(there, axis=1)
        return turns, solved, diverged

    def _at_goals(self, goal: StateArray, reach_m: float) -> BoolArray:
        """(N, K) whether an object counts as at its goal, of (N, 3 K): within ``reach_m``.

        What both fingers hold counts only once all others are there: he would hold the first one to the end. A gripper
        that is blocked holds nothing.
        """
        there = distances(self.worlds.object_position, goal) <= reach_m
        held = self.worlds.contacts().reshape(*there.shape, 2).all(axis=2) & ~self.worlds.blocked[:, None]
        others_there = there.sum(axis=1, keepdims=True) - there == there.shape[1] - 1
        counted: BoolArray = there & (~held | others_there)
        return counted

    def _worth(self, there: BoolArray) -> FloatArray:
        """(N,) reward of having (N, K) objects at their goals."""
        game = self.config.game
        worth: FloatArray = game.bob_success_reward * there.sum(axis=1, dtype=np.float32)
        return worth + game.bob_all_reward * there.all(axis=1).astype(np.float32)

    def _count_reached(self, worlds: IntArray) -> None:
        position = self.worlds.object_position[worlds]
        inside = in_workspace(each_object(position), self.config.world.workspace)
        self.reached += self.cells.count(self.cells.index(position)[inside])

    def _reward_alice(
        self, alice: Turns, verdict: NDArray[np.int8], tried: BoolArray, solved: BoolArray, novelty: StateArray
    ) -> None:
        game = self.config.game
        valid = verdict == Verdict.VALID
        last = int(np.flatnonzero(alice.active.any(axis=1))[-1])
        alice.reward[last, valid] += game.alice_valid_reward + game.alice_novelty_reward * novelty[valid]
        alice.reward[last, valid & tried & ~solved] += game.alice_difficult_reward
        # What a valid goal was worth is unknown where Bob could not try it.
        alice.learn[valid & ~tried] = False

    def _demonstrations(self, alice: Turns, bob: Turns, records: GoalRecords, achieved: StateArray) -> Demonstrations:
        """Alice's turns for the goals the current Bob failed; with hindsight, also steps of his own failures."""
        failed = records.played & ~records.solved & ~records.bob_past
        hers = failed & ~records.replayed
        by_alice = self._relabelled(alice, alice.active & hers, records.goal)
        if not self.config.learner.abc.hindsight:
            return by_alice
        config = self.config
        moved = classify_goal(records.start_position, achieved, config.world.workspace, config.game.success_distance_m)
        steps = bob.active & failed & (moved == Verdict.VALID)
        if config.world.num_objects > 1:
            # Else most steps would show him waiting: his turns are long, and what he moves he often moves early.
            place = bob.observation[..., self.worlds.observed.bob["object"]]
            steps &= (distances(place, achieved) > config.game.success_distance_m).any(axis=-1)
        by_bob = self._relabelled(bob, steps, achieved)
        # No more of his steps than of hers: he fails in several times as many, and would drown what she shows him.
        every = -(-len(by_bob.observation) // max(1, len(by_alice.observation))) or 1
        if not config.game.alice_plays:
            every = _HINDSIGHT_STRIDE
        return join_demonstrations([by_alice, Demonstrations(by_bob.observation[::every], by_bob.action[::every])])

    def _relabelled(self, turns: Turns, steps: BoolArray, goal: StateArray) -> Demonstrations:
        """Demonstrations, with Bob's input, of how to reach (N, 3 K) goals: ``steps`` (T, N) of turns."""
        goals = np.broadcast_to(goal, (*steps.shape, goal.shape[1]))[steps]
        positions = turns.observation[steps][:, : self.worlds.observed.positions.size]
        return Demonstrations(bob_observation(positions, goals), turns.action[steps])

    def _continue_games(self, end_state: StateArray, going_on: BoolArray) -> None:
        """Begin the next round at ``end_state`` (N, S) in the worlds ``going_on`` (N,), a new game in the others."""
        self.worlds.restore(end_state)
        self._round_index += 1
        over = ~going_on | (self._round_index >= self.config.game.num_goals)
        self.worlds.reset(self._rng, over)
        self._round_index[over] = 0

    def state(self) -> Arrays:
        """Everything later rounds depend on, except the random generator, which its owner saves."""
        return {
            "worlds": self.worlds.states.copy(),
            "round_index": self._round_index.copy(),
            "sequence": np.array(self._sequence),
        }

    def load_state(self, state: Arrays) -> None:
        """Continue exactly where ``state`` was taken."""
        self.worlds.restore(np.asarray(state["worlds"], dtype=np.float64))
        self._round_index = np.asarray(state["round_index"], dtype=np.int64).copy()
        self._sequence = int(state["sequence"])


def _act(
    current: StochasticPolicy,
    past: Sequence[StochasticPolicy],
    opponent: IntArray,
    observation: FloatArray,
    worlds: IntArray,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Actions (M, A) and log-probabilities (M,) of M ``worlds``, each by the policy that plays there."""
    opponents = opponent[worlds]
    if (opponents == CURRENT).all():
        return current.act(observation, rng)
    action = np.empty((worlds.size, ACTION.size), dtype=np.float32)
    log_prob = np.empty(worlds.size, dtype=np.float32)
    for index in np.unique(opponents):
        rows = opponents == index
        policy = current if index == CURRENT else past[index]
        action[rows], log_prob[rows] = policy.act(observation[rows], rng)
    return action, log_prob


def _empty_turns(num_steps: int, num: int, observation_size: int, value_size: int, *, learn: BoolArray) -> Turns:
    return Turns(
        observation=np.zeros((num_steps, num, observation_size), dtype=np.float32),
        value_observation=np.zeros((num_steps, num, value_size), dtype=np.float32),
        final_value_observation=np.zeros((num, value_size), dtype=np.float32),
        action=np.zeros((num_steps, num, ACTION.size), dtype=np.float32),
        log_prob=np.zeros((num_steps, num), dtype=np.float32),
        reward=np.zeros((num_steps, num), dtype=np.float32),
        active=np.zeros((num_steps, num), dtype=bool),
        terminated=np.zeros((num_steps, num), dtype=bool),
        learn=learn.copy(),
    )


def _contact_metrics(contacts: BoolArray) -> Metrics:
    both: BoolArray = np.all(contacts.reshape(len(contacts), -1, 2), axis=2)
    return {
        "alice/contact_fraction": float(contacts.any(axis=1).mean()),
        "alice/both_contact_fraction": float(both.any(axis=1).mean()),
    }
