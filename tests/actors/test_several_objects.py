"""The game with two cubes: what is paid, and runs that go on bit for bit."""

import numpy as np
import pytest

from service.actors.self_play import SelfPlay
from service.config import parse_config
from service.envs.observations import distances, each_object
from service.generator.validity import Verdict
from tests.actors.players import Constant, Noise, alices_own, assert_same_rollout, given, make_config, play
from tests.runs.runs import TREE, assert_same_run
from tests.runs.runs import play as run

TWO = {"objects": ["cube", "cube"], "physics_step_s": 0.004, "num_substeps": 10}
RED, BLUE = (-0.15, 0.1, 0.025), (0.05, -0.1, 0.025)


def make_game(num_worlds=1, *, seed=0, places=(RED, BLUE), settings=None, **game):
    config = make_config(num_worlds, game={"bob_all_reward": 5.0, **game}, world=TWO, **(settings or {}))
    made = SelfPlay(config, np.random.default_rng(seed), num_threads=1)
    if places is not None:
        states, layout = made.worlds.states.copy(), made.worlds.layout
        states[:, layout["object"]], states[:, layout["object_2"]] = places
        made.worlds.restore(states)
    return made


def slides(game, name, speed_m_s):
    """Let an object slide along x: with friction 1 it goes v^2 / (2 g)."""
    states, first = game.worlds.states.copy(), game.worlds.layout[f"{name}_velocity"].start
    states[:, first] = speed_m_s
    game.worlds.restore(states)


def paid(game, goal):
    return play(game, choose_goals=given(np.array(goal))).bob.reward[:, 0].tolist()


def test_what_lies_at_its_goal_at_the_start_pays_nothing_until_it_leaves():
    far = (0.1, 0.1, 0.025)
    game = make_game()
    assert paid(game, [*RED, *far]) == [0.0] * 14
    slides(game := make_game(), "object", 1.5)  # 11 cm: red leaves its goal
    assert sorted(paid(game, [*RED, *far])) == [-1.0] + [0.0] * 13


def test_each_that_comes_pays_and_all_pay_more():
    slides(game := make_game(), "object_2", 1.0)  # 5 cm
    goal = [*RED, BLUE[0] + 0.08, *BLUE[1:]]
    rewards = paid(game, goal)
    assert sorted(rewards) == [*[0.0] * (len(rewards) - 1), 1.0 + 5.0]
    slides(game := make_game(bob_all_reward=0.0), "object_2", 1.0)
    assert sorted(paid(game, goal))[-1] == 1.0


def test_where_all_are_there_the_turn_is_paid_as_ever():
    rollout = play(make_game(bob_hold_steps=2), choose_goals=given(np.array([*RED, *BLUE])))
    assert rollout.bob.reward[:, 0].tolist()[:2] == [7.0, 0.0]
    assert rollout.records.num_bob_steps.tolist() == [2]
    assert rollout.records.solved.tolist() == [True]


def test_the_turn_ends_when_all_are_held():
    slides(game := make_game(bob_hold_steps=2), "object_2", 1.0)
    rollout = play(game, choose_goals=given(np.array([*RED, BLUE[0] + 0.08, *BLUE[1:]])))
    path = rollout.bob.observation[:, 0, game.worlds.observed.bob["object"]]
    there = distances(path, rollout.records.goal[0]) <= 0.05
    first = int(np.argmax(there.all(axis=1)))
    assert rollout.records.num_bob_steps[0] == first + 1  # it is seen a step before it is paid


class Grasper(Constant):
    """Goes down to the table, closes the gripper for six steps, and opens it."""

    def act(self, observation, rng):
        action, log_prob = super().act(observation, rng)
        step = len(self.seen) - 1
        action[:, 2], action[:, 3] = (-1.0, 0.0) if step < 4 else (0.0, -1.0 if step < 10 else 1.0)
        return action, log_prob


@pytest.mark.parametrize("blue_is_there", [True, False])
def test_what_is_held_counts_once_all_others_are_there(blue_is_there):
    under = (-0.05, 0.0, 0.025)
    choose = given(np.array([*under, *(BLUE if blue_is_there else (0.1, 0.15, 0.025))]))
    game, held = make_game(places=(under, BLUE), bob_steps=16, bob_hold_steps=20), []
    rollout = play(
        game, bob=Grasper(), choose_goals=choose, observe=lambda _: held.append(game.worlds.contacts()[0, :2].all())
    )
    held = held[-rollout.records.num_bob_steps[0] :]  # after each step of Bob's
    begins, ends = held.index(True), held.index(False, held.index(True))
    assert 4 <= begins < ends < 15
    paid = rollout.bob.reward[:, 0].tolist()
    changes = {0: 7.0} if blue_is_there else {begins: -1.0, ends: 1.0}
    assert {step: reward for step, reward in enumerate(paid) if reward} == changes


@pytest.mark.parametrize("blocked", [True, False])
def test_a_gripper_that_is_blocked_holds_nothing(monkeypatch, blocked):
    """Closed fingers may both touch what they push."""
    game, red_alone = make_game(blocked_gripper_fraction=0.5), np.array([[*RED, *RED]])
    states = game.worlds.states.copy()
    states[:, game.worlds.layout["gripper_blocked"]] = blocked
    game.worlds.restore(states)
    monkeypatch.setattr(game.worlds, "contacts", lambda: np.array([[True, True, False, False]]))
    assert game._at_goals(red_alone, 0.05).tolist() == [[blocked, False]]
    assert game._at_goals(np.array([[*RED, *BLUE]]), 0.05).tolist() == [[True, True]]


def test_a_turn_has_time_for_each_object_that_has_to_be_moved():
    far = (0.1, 0.15, 0.025)
    game = make_game(3, bob_hold_steps=20)
    rollout = play(game, choose_goals=given(np.array([[*RED, *far], [*far, *BLUE], [*BLUE, *RED]])))
    assert rollout.records.num_bob_steps.tolist() == [7, 7, 14]
    assert rollout.bob.active.sum(axis=0).tolist() == [7, 7, 14]
    assert not rollout.bob.terminated.any()  # running out of time is no end: what comes after counts
    at_goal = play(make_game(bob_hold_steps=20), choose_goals=given(np.array([*RED, *BLUE])))
    assert at_goal.records.num_bob_steps.tolist() == [14]


def test_alices_goal_keeps_what_she_did_not_move():
    slides(game := make_game(), "object", 1.5)
    states, first = game.worlds.states.copy(), game.worlds.layout["object_2_velocity"].start
    states[:, first] = 0.5  # a nudge of 1 cm
    game.worlds.restore(states)
    rollout = play(game)
    goal = each_object(rollout.records.goal)[0]
    assert rollout.records.verdict.tolist() == [Verdict.VALID]
    assert goal[0, 0] > RED[0] + 0.1
    np.testing.assert_allclose(goal[1], BLUE)


def test_cells_count_where_each_object_was():
    game = make_game()
    play(game)
    half = len(game.cells) // 2
    assert np.flatnonzero(game.reached).tolist() == game.cells.index(np.array([[*RED, *BLUE]]))[0].tolist()
    assert game.reached[:half].sum() == game.reached[half:].sum() == 9


def test_a_game_goes_on_where_its_state_was_taken():
    def both():
        return make_game(6, seed=1, places=None, num_goals=5)

    game, later = both(), both()
    play(game, Noise(), Noise())
    state = game.state()
    later.load_state(state)
    later._rng.bit_generator.state = game._rng.bit_generator.state
    for _ in range(2):
        one, other = (play(each, Noise(), Noise(), choose_goals=alices_own) for each in (game, later))
        assert_same_rollout(one, other)


def test_hindsight_leaves_out_steps_after_which_nothing_moves():
    """Red slides 11 cm in four steps, and is 11.5, 6.3 and 2.6 cm from its end in the first three."""
    settings = {
        "learner": {"abc": {"hindsight": True}},
        "generator": {"goal_source": "uniform", "replay_invalid": True},
    }
    slides(game := make_game(8, settings=settings, alice_plays=False), "object", 1.5)
    rollout = play(game, choose_goals=given(np.array([0.1, 0.1, 0.025, *BLUE])))
    assert not rollout.records.solved.any()
    found = rollout.demonstrations.observation
    assert len(found) == 2 * 8 // 4  # one in four is shown
    seen = game.worlds.observed.bob
    assert (distances(found[:, seen["object"]], found[:, seen["goal"]]).max(axis=1) > 0.05).all()


@pytest.fixture(scope="module")
def config():
    game = TREE["game"] | {"bob_all_reward": 5.0}
    world = TREE["world"] | {"objects": ["cube", "cube"], "object_size_m": 0.04}
    world |= {"workspace": {"length_x_m": 0.3, "length_y_m": 0.3}}
    run = TREE["run"] | {"total_env_steps": 800, "evaluation_interval": 2, "evaluation_episodes": 3}
    return parse_config(TREE | {"game": game, "world": world, "run": run}, where="a test")


def test_a_run_that_is_killed_goes_on_bit_for_bit(config, tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    run(whole, config)
    run(killed, config, kill_after=3)
    run(killed, config, resume=True)
    assert_same_run(whole, killed)
