"""What goes on in a live world, without a browser."""

import dataclasses

import numpy as np
import pytest
import torch

from service.actors.evaluation import IdlePolicy
from service.base.errors import TandemError
from service.envs.observations import layouts
from service.envs.task import Task
from service.envs.tasks import find_task
from service.learner.sac_networks import GaussianActor
from service.policies.learned_policy import LearnedPolicy, action_weights, num_inputs
from service.policies.networks import export_parameters
from service.registry.loading import Trained
from service.robot.play.game import Game


@pytest.fixture
def game(champion):
    game = Game(champion, seed=1)
    yield game
    game.close()


def go(game, num):
    for _ in range(num):
        game.step()


def test_bob_goes_where_the_goal_is_put_and_stays(game):
    """From wherever he is: no reset comes between."""
    for goal in ([0.1, 0.1, 0.2], [-0.1, -0.05, 0.1]):
        game.set_goal(np.array(goal))
        go(game, 75)
        distance_m = np.linalg.norm(game.worlds.object_position[0] - goal)
        assert distance_m < 0.05
        assert game.caption == f"At the goal, {100 * distance_m:.1f} cm away"
    game.set_goal(np.array([9.0, 0.0, -1.0]))
    workspace = game.world.workspace
    assert game.goal.tolist() == [workspace.upper_m[0], 0.0, game.world.rest_height_m]


def test_who_misses_the_goal_that_was_put_begins_anew(game):
    """A Bob who still learns may be stuck; the goal stays, and he tries again."""
    game.take(dataclasses.replace(game.players, policy=IdlePolicy()))
    game.set_goal(np.array([0.1, 0.1, 0.2]))
    start, captions = game.worlds.object_position[0].copy(), set()
    for _ in range(120):
        game.step()
        captions.add(game.caption)
    assert "Not there in 3.2 s" in captions
    assert game.goal.tolist() == [0.1, 0.1, 0.2]
    assert np.linalg.norm(game.worlds.object_position[0] - start) > 0.01  # another start


def test_a_goal_that_was_reached_may_be_lost_and_reached_again(game):
    """His time counts from when the object was last there."""
    game.set_goal(np.array([0.1, 0.1, 0.2]))
    there = game._rules.solved
    captions = set()
    for step in range(400):
        game._rules.solved = (lambda goal: np.array([False])) if step in range(200, 220) else there
        game.step()
        captions.add(game.caption)
    assert not any(caption.startswith("Not there") for caption in captions)


def test_another_goal_comes_when_he_is_there(game):
    goals = set()
    for _ in range(150):
        goals.add(tuple(game.goal))
        game.step()
    assert len(goals) > 2


def test_weights_that_are_set_drive_the_primitives(game, champion):
    go(game, 3)
    gate = champion.primitives.gate(np.concatenate((game.worlds.positions()[0], game.goal)).astype(np.float32))
    start = game.state.copy()
    game.set_mode("primitives")
    np.testing.assert_allclose(game.weights, gate, rtol=1e-5)  # nothing changes until somebody sets one
    np.testing.assert_array_equal(game.state, start)
    ends = []
    for action in np.eye(champion.primitives.num_primitives, dtype=np.float32)[:2] * 2 - 1:
        game.worlds.restore(start[None])
        game.weights = action_weights(action)
        means, _ = champion.primitives.compose(game.worlds.positions(), game.weights[None])
        before = game.worlds.ee_position[0].copy()
        game.step()
        moved = game.worlds.ee_position[0] - before
        assert moved @ means[0, :3] > 0.0  # towards what the composition says
        ends.append(game.state.copy())
    assert (ends[0] != ends[1]).any()
    assert not game.shows_goal
    with pytest.raises(TandemError, match=r"mode 'alice': panda-cube@\d+ .* can do goals, primitives"):
        game.set_mode("alice")


class Carrying:
    """An Alice who carries the object to one place: Bob, who is told of it."""

    def __init__(self, bob, num_positions):
        self._bob, self._num = bob, num_positions

    def act(self, observation, rng):
        goal = np.array([[0.12, 0.12, 0.22]], dtype=np.float32)
        return self._bob.act_deterministic(np.concatenate((observation[:, : self._num], goal), axis=1)), np.zeros(1)


def test_alice_proposes_and_bob_follows_from_her_start(champion):
    rules = {"alice_steps": 40, "num_goals": 2, "bob_steps": 60, "bob_hold_steps": 5}
    config = champion.config.model_copy(update={"game": champion.config.game.model_copy(update=rules)})
    alice = Carrying(champion.policy, champion.primitives.num_positions)
    game = Game(dataclasses.replace(champion, config=config, alice=alice), seed=0)
    assert game.modes == ("goals", "primitives", "alice")
    game.set_mode("alice")
    start = game.state.copy()
    go(game, 39)
    assert game.caption.startswith("Alice proposes: 1.")
    assert not game.shows_goal
    game.step()
    assert game.caption == "Alice proposed this goal"
    proposed, goal = game.worlds.object_position[0].copy(), game.goal.copy()
    np.testing.assert_array_equal(proposed, goal)
    assert np.linalg.norm(proposed - (0.12, 0.12, 0.22)) < 0.05
    go(game, 15)  # stillness
    np.testing.assert_array_equal(game.state, start)
    assert game.shows_goal
    for _ in range(61):
        if game.caption.startswith("Bob: "):
            break
        game.step()
    assert game.caption.startswith("Bob: solved after")
    go(game, 15)
    np.testing.assert_array_equal(game.worlds.object_position[0], proposed)  # the next round goes on from there
    assert not game.shows_goal
    game.close()


def test_a_fallen_object_comes_back(game):
    game.worlds.object_position[0] = (0.9, 0.0, -0.1)
    game.step()
    assert game.caption == "the object fell off the table"
    go(game, 20)
    assert game.worlds.object_position[0, 2] > 0.0


def test_a_task_and_its_orchestrator(champion):
    """An orchestrator acts in the world of its task, and forgets where episodes begin."""
    begun = []

    class Counting(LearnedPolicy):
        def begin(self):
            begun.append(1)
            super().begin()

    seen, num = layouts(champion.config.world), champion.primitives.num_primitives
    with torch.random.fork_rng():
        torch.manual_seed(4)
        actor = export_parameters(GaussianActor(num_inputs(seen)[1], num, (8,)))
    policy = Counting(actor, champion.primitives, seen)
    common = {"task": find_task("wall"), "method": "ours", "acts_with": champion}
    game = Game(Trained("mine@1", "orchestrator", champion.config, policy, actor, **common), seed=0)
    begun.clear()
    game.reset()
    assert game.title == "mine@1 on Wall"
    assert game.world.fixture == "wall"
    assert game.modes == ("goals", "primitives")
    assert begun
    assert game.weights_now() is None  # an orchestrator's are not known here
    game.set_goal(np.array([0.05, 0.0, 0.1]))
    for goal in ([-0.05, 0.0, 0.03], [-0.05, 0.0, 0.2]):  # in the wall, and above it
        game.set_goal(np.array(goal))
        assert game.goal.tolist() == ([0.05, 0.0, 0.1] if goal[2] < 0.1 else goal)
    go(game, 2)
    game.reset()
    assert len(begun) == 2
    game.close()


def test_a_users_goals_begin_where_episodes_do(champion):
    """Asked wherever the cube came to, they would walk off the table."""
    task = Task("Away", goals=lambda s, rng: np.add(s.objects.place, [0.05, 0.0, 0.0]))
    game, ends = Game(champion.playing(task), seed=1), set()
    for _ in range(400):
        game.step()
        ends.add(game.caption.partition(" after ")[0])
        way = game.goal - game._start_position[0]
    game.close()
    assert "There" in ends
    np.testing.assert_allclose(way, [0.05, 0.0, 0.0], atol=1e-9)


def test_a_users_starts_see_the_episode_that_begins(champion):
    seen = []

    def starts(s, rng):
        seen.append((s.elapsed.copy(), s.memory.copy()))
        return s.objects.place

    task = Task("Counted", starts=starts, remember=lambda s: s.memory + 1, memory_size=1, episode_steps=20)
    game = Game(champion.playing(task), seed=1)
    go(game, 5)
    game.reset()
    game.close()
    assert [(elapsed.tolist(), memory.tolist()) for elapsed, memory in seen] == [([0], [[0.0]])] * len(seen)
    assert len(seen) >= 2
