"""Scripted players, and starts whose outcome is known: an object that slides, falls off the table or stays."""

from dataclasses import dataclass, fields
from types import SimpleNamespace

import numpy as np

from service.actors.rollout import to_arrays
from service.actors.self_play import Players, SelfPlay
from service.config import parse_config
from service.generator.opponents import CURRENT, RoundPlan
from service.generator.snapshot import GoalChoice
from service.generator.validity import Verdict

OBJECT, OBJECT_VELOCITY = slice(10, 13), slice(26, 29)
"""Where they stand in a world's flat state: after time, 7 joints, 2 fingers; then 7 + 2 velocities."""


class Constant:
    """Always the same action; its log-probability is a mark by which to know whose action it was."""

    def __init__(self, action=(0.0, 0.0, 0.0, 0.0), mark=0.0):
        self.action, self.mark = np.asarray(action, dtype=np.float32), mark
        self.seen = []

    def act(self, observation, rng):
        self.seen.append(observation.copy())
        num = len(observation)
        return np.tile(self.action, (num, 1)), np.full(num, self.mark, dtype=np.float32)


class Pusher(Constant):
    """Closes the fingers, goes down to the table behind the object and pushes it 7 cm forward."""

    def act(self, observation, rng):
        action, log_prob = super().act(observation, rng)
        height = observation[:, 2]
        action[:, 0] = np.where(height < 0.05, np.clip((0.06 - observation[:, 0]) / 0.05, -1.0, 1.0), 0.0)
        action[:, 2] = np.clip((0.03 - height) / 0.05, -1.0, 1.0)
        action[:, 3] = -1.0
        return action, log_prob


class Noise:
    """Draws from the game's own generator."""

    def act(self, observation, rng):
        action = rng.standard_normal((len(observation), 4), dtype=np.float32)
        return action, -np.square(action).sum(axis=1)


@dataclass(frozen=True)
class Start:
    """One object: where it is, and how fast it slides along x or y, m/s."""

    position: tuple[float, float, float]
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)


# The workspace of the default configuration is x -0.225 to 0.125, y -0.175 to 0.175; the table ends at y = 0.45. With
# friction 1 a cube that starts at v slides v^2 / (2 g): 11.5 cm at 1.5 m/s. The end effector starts over (-0.05, 0).
IN_FRONT = Start((0.03, 0.0, 0.025))
AT_REST = Start((-0.15, 0.13, 0.025))
SLIDES = Start((-0.12, -0.15, 0.025), (1.5, 0.0, 0.0))
LEAVES = Start((0.08, 0.15, 0.025), (1.5, 0.0, 0.0))
FALLS = Start((-0.30, 0.44, 0.025), (0.0, 2.5, 0.0))


def make_config(num_worlds, *, game=None, **rooms):
    """Turns of 9 and 7 steps, enough for a push and a slide."""
    base = {"num_worlds": num_worlds, "alice_steps": 9, "bob_steps": 7}
    return parse_config({"game": base | (game or {}), **rooms}, where="a test")


def make_game(config, starts=None, *, seed=0, **kwargs):
    game = SelfPlay(config, np.random.default_rng(seed), num_threads=1, **kwargs)
    if starts is not None:
        place(game, starts)
    return game


def place(game, starts):
    """Put each world's object where its ``Start`` says; the arm stays."""
    states = game.worlds.states.copy()
    states[:, OBJECT] = [start.position for start in starts]
    states[:, OBJECT_VELOCITY] = [start.velocity for start in starts]
    game.worlds.restore(states)


def everyone_current(num_worlds):
    return RoundPlan(np.full(num_worlds, CURRENT), np.full(num_worlds, CURRENT))


def alices_own(start_state, start_position, round_index, proposal, verdict):
    """Bob plays every valid goal, nothing else."""
    replayed = np.zeros(len(verdict), dtype=bool)
    return GoalChoice(
        proposal.copy(),
        start_state.copy(),
        start_position.copy(),
        replayed,
        np.asarray(round_index == 0),
        np.asarray(verdict == Verdict.VALID),
        np.where(verdict == Verdict.VALID, 0.25, 0.0),
    )


def given(goal, own=()):
    """Bob plays these goals, (3,) or (N, 3), from where his world is; those of the worlds in ``own`` are Alice's."""

    def choose(start_state, start_position, round_index, proposal, verdict):
        every = np.ones(len(proposal), dtype=bool)
        goals, starts = np.broadcast_to(goal, proposal.shape).copy(), (start_state.copy(), start_position.copy())
        replayed, first = ~np.isin(np.arange(len(every)), own), np.asarray(round_index == 0)
        return GoalChoice(goals, *starts, replayed, first, every, np.zeros(len(every)))

    return choose


def play(game, alice=None, bob=None, *, plan=None, choose_goals=alices_own, version=0, observe=None, **past):
    """One round; players who are not given do nothing."""
    players = Players(version, alice or Constant(), bob or Constant(), **past)
    plan = plan or everyone_current(game.worlds.num_worlds)
    chooser = SimpleNamespace(choose_goals=lambda plan, *played, rng: choose_goals(*played))
    return game.play_round(players, plan, chooser, observe=observe)


def assert_same_rollout(one, other):
    """Every array and number, bit for bit."""
    left, right = to_arrays(one), to_arrays(other)
    assert left.keys() == right.keys()
    for name, array in left.items():
        assert array.dtype == right[name].dtype, name
        assert np.array_equal(array, right[name]), name


def learned_from(turns, worlds):
    """Whether any of these worlds' steps would be learned from."""
    return bool(turns.learn[worlds].any())


def assert_shapes(part, num_steps, num_worlds, observation_size, value_size):
    """As ``Turns`` documents them."""
    sizes = {"observation": (observation_size,), "value_observation": (value_size,), "action": (4,)}
    floats = {"final_value_observation": (num_worlds, value_size), "learn": (num_worlds,)}
    for field in fields(part):
        shape = floats.get(field.name, (num_steps, num_worlds, *sizes.get(field.name, ())))
        assert getattr(part, field.name).shape == shape, field.name
