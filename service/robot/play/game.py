"""What goes on in a live world: one world, stepped by Bob, by weights that a user sets, or by Alice and then Bob.

Nothing is drawn here, and nothing knows of a browser. All of a game is used by one thread.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from service.actors.self_play import StochasticPolicy
from service.base.errors import TandemError
from service.base.types import FloatArray, StateArray
from service.config.self_play import GameConfig, SelfPlayConfig
from service.envs.batch import WorldBatch
from service.envs.observations import bob_observation, distances, each_object
from service.envs.overlap import inside_each_other, inside_fixtures
from service.envs.rules import Rules
from service.generator.validity import FALLEN_BELOW_M, NO_GOAL, Verdict, classify_goal, proposed
from service.policies.numpy_policy import NumpyMCPPolicy
from service.registry.loading import Trained

Mode = Literal["goals", "primitives", "alice"]
"""Bob goes to the goal; primitives act by weights that are set; Alice proposes a goal, and Bob goes there."""
_PAUSE_S = 0.6
"""Stillness after Alice's turn and after a round, so that one sees what came out."""


class Game:
    """One world and its players.

    Args:
        players: Bob, and Alice where a run has her.
        seed: of starts, random goals and Alice's noise.
    """

    def __init__(self, players: Trained, seed: int = 0) -> None:
        config, on_task = players.config, players.task is not None
        rules = config.game if isinstance(config, SelfPlayConfig) else GameConfig()
        self.world = players.nominal.world  # which is what the page shows
        self.take(players)
        self._alice_steps, self._num_rounds = rules.alice_steps, rules.num_goals
        self._bob_steps, self._task_steps = rules.bob_steps, players.num_steps if on_task else None
        self._hold_steps = (players.num_steps // 4 or 1) if on_task else max(rules.bob_hold_steps, 1)
        self._rng = np.random.default_rng(seed)
        self.worlds = WorldBatch(self.world, 1, num_threads=1)
        self._rules = Rules(players.tried_on, self.worlds, players.success_distance_m)
        self.step_s = self.world.step_s
        self.mode: Mode = "goals"
        self.new_goals = True
        """Whether another goal comes when Bob is there, or his time is over."""
        num = self.primitives.num_primitives if self.primitives is not None else 0
        self.weights: FloatArray = np.ones(num, dtype=np.float32)
        """(K,) of the primitives, where they are set."""
        self.caption = ""
        """What goes on, in a few words."""
        self.goal: StateArray = np.zeros(3 * self.world.num_objects)
        """(3 K,) metres."""
        self.num_steps = 0
        """Since the game was made."""
        self._turn: Literal["alice", "bob"] = "bob"
        self._steps = self._held = self._still_steps = self._round = 0
        self._start = self._end_state = self.worlds.states.copy()
        self._after: Literal["reset", "round", "bob"] = "reset"
        self.reset()

    def take(self, players: Trained) -> None:
        """Let these play from now on; of the same run, later ones."""
        config, acting = players.config, players.acts_with or players
        plays = not isinstance(config, SelfPlayConfig) or config.game.alice_plays
        self.players, self.title = players, players.title
        self.primitives = acting.policy if isinstance(acting.policy, NumpyMCPPolicy) else None
        """What sliders drive."""
        self.alice: StochasticPolicy | None = players.alice if plays else None

    def close(self) -> None:
        """Stop the world's threads."""
        self.worlds.close()

    # --- what is seen ------------------------------------------------------------------------------------------------

    @property
    def state(self) -> StateArray:
        """(S,) state of the world."""
        state: StateArray = self.worlds.states[0]
        return state

    @property
    def modes(self) -> tuple[Mode, ...]:
        """What these players can do."""
        possible: dict[Mode, bool] = {
            "goals": True,
            "primitives": self.primitives is not None,
            "alice": self.alice is not None,
        }
        return tuple(mode for mode in possible if possible[mode])

    @property
    def _goals_anywhere(self) -> bool:
        """Whether goals may follow one another: a task's own, and those of a wall, belong to a start."""
        task = self._rules.task
        return self.world.fixture == "none" and task.starts is None and isinstance(task.goals, str)

    @property
    def shows_goal(self) -> bool:
        """Whether there is a goal now."""
        return self.mode == "goals" or (self.mode == "alice" and self._turn == "bob")

    def weights_now(self) -> FloatArray | None:
        """(K,) weights that act now: those that are set, or the gate's; None where neither is known."""
        if self.mode == "primitives":
            return self.weights
        bob = self.players.policy
        if self._turn == "bob" and isinstance(bob, NumpyMCPPolicy):
            gate: FloatArray = bob.gate(bob_observation(self.worlds.positions(), self.goal[None]))[0]
            return gate
        return None

    # --- what people do ----------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Begin anew: the arm at home, the object elsewhere, and the goal, too, unless it was put where it is."""
        self.worlds.reset(self._rng)
        self._begin_turn("alice" if self.mode == "alice" else "bob")
        self._rules.place(self._rng)
        self._round = 0
        if self.new_goals:
            self._draw_goal()

    def set_mode(self, mode: Mode) -> None:
        """Change who acts.

        Raises:
            TandemError: no such player here.
        """
        if mode not in self.modes:
            raise TandemError(f"mode {mode!r}: {self.title} can do {', '.join(self.modes)}")
        if mode == "primitives" and (weights := self.weights_now()) is not None:
            self.weights = weights.copy()  # as the gate had them last: what follows is seen to come from the person
        changed, self.mode = mode != self.mode, mode
        if changed and mode == "alice":
            self.reset()
        elif changed:
            self._begin_turn("bob")

    def set_goal(self, goal: StateArray) -> None:
        """Put goals at (3 K,) metres, or the nearest place in the workspace; Bob goes there and stays, or tries again.

        Where an object would be inside a fixture or another object there is no goal: it stays where it was.
        """
        workspace = self.world.workspace
        low = [(*workspace.lower_m[:2], height) for height in self.world.rest_heights_m]
        place = np.clip(each_object(np.asarray(goal, dtype=np.float64)), low, workspace.upper_m).ravel()
        if inside_fixtures(place[None], self.world)[0] or inside_each_other(place[None], self.world)[0]:
            return
        self.goal = place
        self.new_goals = False
        if self.mode == "goals":
            self._begin_turn("bob", forget=False)

    # --- what happens ------------------------------------------------------------------------------------------------

    def step(self) -> None:
        """Let 40 ms go by in the world, or as long as its control step is."""
        self.num_steps += 1
        if self._still_steps:
            self._still_steps -= 1
            if not self._still_steps:
                self._go_on()
            return
        diverged = bool(self.worlds.step(self._action())[0])
        self._rules.advance(self.goal[None])
        self._steps += 1
        if diverged or each_object(self.worlds.object_position[0])[:, 2].min() < FALLEN_BELOW_M:
            self._pause("the object fell off the table" if not diverged else "the physics diverged", "reset")
        elif self._turn == "alice":
            self.caption = f"Alice proposes: {self._seconds()}"
            if self._steps >= self._alice_steps:
                self._judge()
        elif self.mode == "primitives":
            self.caption = "Primitives by your weights"
        else:
            self._follow_bob()

    def _action(self) -> FloatArray:
        worlds = self.worlds
        if self._turn == "alice":
            assert self.alice is not None
            return self.alice.act(worlds.full(self._steps / self._alice_steps), self._rng)[0]
        if self.mode == "primitives":
            assert self.primitives is not None
            return self.primitives.compose(worlds.positions(), self.weights[None])[0]
        return self.players.act_deterministic(bob_observation(worlds.positions(), self.goal[None]))

    def _follow_bob(self) -> None:
        distance_m = float(distances(self.worlds.object_position, self.goal[None]).max())
        there, own = bool(self._rules.solved(self.goal[None])[0]), self._rules.task.success is not None
        self._held = self._held + 1 if there else 0
        self.caption = f"On the way: {self._seconds()}"
        if there:
            self.caption = "Solved" if own else f"At the goal, {100 * distance_m:.1f} cm away"
        put = self.mode == "goals" and not self.new_goals  # by hand, and so from anywhere: it may take longer
        if there and put:
            self._steps = 0  # where it slips away he has his time again
        solved, late = self._held >= self._hold_steps, self._steps >= self._most_steps() * (1 + put)
        if self.mode == "alice":
            if solved or late:
                self._pause(f"Bob: solved after {self._seconds()}" if solved else "Bob: not solved", "round")
        elif late and not there:  # who learns may be stuck for ever otherwise
            self._pause(f"Not there in {self._seconds()}", "reset")
        elif self.new_goals and solved and self._steps >= 1 / self.step_s:  # a goal beside the object is seen, too
            if self._goals_anywhere:
                self._begin_turn("bob", forget=False)
                self._draw_goal()
            else:
                self._pause(f"There after {self._seconds()}", "reset")

    def _most_steps(self) -> int:
        """Of Bob's turn: an episode of the task, or what he has in self-play."""
        if self._task_steps is not None:
            return self._task_steps
        away = distances(self._start_position, self.goal[None]) > self.players.success_distance_m
        return self._bob_steps * (int(np.count_nonzero(away)) or self.world.num_objects)

    def _judge(self) -> None:
        """Take where Alice left the object for a goal, or say why it is none."""
        near_m, end = self.players.success_distance_m, self.worlds.object_position.copy()
        verdict = Verdict(classify_goal(self._start_position, end, self.world.workspace, near_m)[0])
        self._end_state, self.goal = self.worlds.states.copy(), proposed(self._start_position, end, near_m)[0]
        if verdict == Verdict.VALID:
            self._pause("Alice proposed this goal", "bob")
        else:
            self._pause(f"Alice: no goal, {NO_GOAL[verdict]}", "reset")

    def _pause(self, caption: str, after: Literal["reset", "round", "bob"]) -> None:
        self.caption, self._after, self._still_steps = caption, after, max(round(_PAUSE_S / self.step_s), 1)

    def _go_on(self) -> None:
        """Do what comes after stillness."""
        if self._after == "bob":
            self.worlds.restore(self._start)
            self._begin_turn("bob")
        elif self._after == "round" and self._round + 1 < self._num_rounds:
            self._round += 1
            self.worlds.restore(self._end_state)  # as games do: the next round starts where Alice ended
            self._begin_turn("alice")
        else:
            self.reset()

    def _begin_turn(self, turn: Literal["alice", "bob"], *, forget: bool = True) -> None:
        """Begin a turn; ``forget`` where the world has jumped, or another policy acted."""
        self._turn, self._steps, self._held, self._still_steps = turn, 0, 0, 0
        self._start, self._start_position = self.worlds.states.copy(), self.worlds.object_position.copy()
        self.caption = "Alice proposes" if turn == "alice" else "On the way"
        self._rules.begin(np.ones(1, dtype=bool))
        if forget:
            self.players.begin()

    def _draw_goal(self) -> None:
        self.goal = self._rules.draw(self._rng)[0]

    def _seconds(self) -> str:
        return f"{self._steps * self.step_s:.1f} s"
