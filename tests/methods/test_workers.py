"""The workers of both runners: a round needs nothing but what it is given at its start."""

import pickle
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from service.config import parse_config
from service.generator.ring import join_rows
from service.learner.learner import Learner
from service.methods.workers import GeneratorWorker, RolloutWorker
from tests.actors.players import assert_same_rollout
from tests.runs.runs import TREE, tiny_config


@pytest.fixture
def config():
    return tiny_config()


@pytest.fixture
def make_actor(config):
    workers = []

    def make(actor=0, incarnation=0, config=config):
        workers.append(RolloutWorker(config, actor, incarnation, num_threads=1))
        return workers[-1]

    yield make
    for worker in workers:
        worker.game.close()


@pytest.fixture
def learned(config, make_actor):
    """Weights, and a generator that has past players and goals to replay."""
    generator, weights, actor = GeneratorWorker(config), Learner(config).weights(), make_actor()
    for iteration in range(10):
        _, goals, _ = actor.play(weights, generator.generator.snapshot(), generator.generator.opponents)
        generator.record(iteration, weights, [goals])
    return weights, generator


def as_sent(value):
    """What another process gets: a copy that cannot be written to."""
    buffers = []
    text = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    return pickle.loads(text, buffers=[bytes(buffer.raw()) for buffer in buffers])


def test_each_actor_and_each_that_replaces_one_plays_other_games(make_actor):
    games = [make_actor(*which).game.worlds.object_position for which in ((0, 0), (1, 0), (0, 1))]
    assert all((one != other).any() for one, other in combinations(games, 2))


def test_grippers_are_blocked_by_the_success_that_the_generator_tells(make_actor):
    game = TREE["game"] | {"blocked_gripper_fraction": 0.5, "blocked_gripper_min_success": 0.6}
    config = parse_config(TREE | {"game": game}, where="a test")
    generator, weights, actor = GeneratorWorker(config).generator, Learner(config).weights(), make_actor(config=config)
    fractions = []
    for rate in (0.59, 0.6):
        actor.play(weights, replace(generator.snapshot(), success_rate=np.array(rate)), generator.opponents)
        fractions.append(actor.game.worlds.blocked_fraction)
    assert fractions == [0.0, 0.5]


def test_a_round_is_a_function_of_what_it_is_given(learned, make_actor):
    weights, generator = learned
    given = weights, generator.generator.snapshot(), generator.generator.opponents
    sent = as_sent(given)
    assert not sent[1].buffer["goal"].flags.writeable
    here, there = make_actor(), make_actor()
    for _ in range(2):
        one, goals, _ = here.play(*given)
        other, same, _ = there.play(*sent)
        assert_same_rollout(one, other)
        assert goals.metrics == same.metrics
        assert here.rng.bit_generator.state == there.rng.bit_generator.state
    records = one.records
    assert records.replayed.any()
    assert records.alice_past.any()
    assert records.bob_past.any()


def test_without_alice_no_world_has_a_past_player(learned, make_actor):
    weights, generator = learned
    tree = TREE | {
        "game": TREE["game"] | {"alice_plays": False},
        "generator": TREE["generator"] | {"goal_source": "uniform", "replay_invalid": True},
    }
    alone = make_actor(config=parse_config(tree, where="a test"))
    rollout, _, _ = alone.play(weights, generator.generator.snapshot(), generator.generator.opponents)
    assert not rollout.records.alice_past.any()
    assert not rollout.records.bob_past.any()


def test_the_generator_hears_of_every_game_that_began(learned, make_actor, config):
    weights, generator = learned
    given, actor = (generator.generator.snapshot(), generator.generator.opponents), make_actor(1)
    began = []
    for _ in range(3):
        before = actor.game.worlds.states.copy()
        rollout, goals, _ = actor.play(weights, *given)
        began.append(goals.starts)
        assert np.array_equal(goals.starts["start_state"], before[rollout.records.round_index == 0])
    starts = join_rows(began)["start_position"]
    assert config.game.num_worlds < len(starts) < 3 * config.game.num_worlds
    assert starts.std(axis=0)[:2].min() > 0.0


def test_the_generator_hears_of_every_later_round_that_begins_in_the_hand(learned, make_actor):
    weights, generator = learned
    given, actor = (generator.generator.snapshot(), generator.generator.opponents), make_actor(1)
    worlds, contacts = actor.game.worlds, actor.game.worlds.layout["contacts"]
    actor.play(weights, *given)
    states = worlds.states.copy()
    states[:, contacts] = [(1.0, 1.0), (1.0, 0.0)] * (len(states) // 2)
    worlds.restore(states)
    rollout, goals, _ = actor.play(weights, *given)
    later = rollout.records.round_index > 0
    assert later[::2].any()
    assert later[1::2].any()
    assert np.array_equal(goals.held_starts["start_state"], states[::2][later[::2]])
    assert np.array_equal(goals.starts["start_state"], states[~later])


def test_many_rounds_of_an_iteration_share_the_places(learned, make_actor, config):
    weights, generator = learned
    given = generator.generator.snapshot(), generator.generator.opponents
    alone, one_of_many = make_actor(), make_actor()
    _, whole, _ = alone.play(weights, *given)
    _, sample, _ = one_of_many.play(weights, *given, num_rounds=config.generator.replay_buffer_size // 2)
    assert len(whole.goals["goal"]) > 2
    assert len(sample.goals["goal"]) == 2
    assert len(sample.starts["start_state"]) == 1
    assert sample.metrics == whole.metrics
    assert np.array_equal(sample.tries, whole.tries)


def test_past_players_are_built_once(learned, make_actor, config):
    weights, generator = learned
    snapshot, opponents, actor = generator.generator.snapshot(), generator.generator.opponents, make_actor()
    built = []
    for _ in range(2):
        _, goals, _ = actor.play(weights, snapshot, opponents)
        built.append(actor._past)
    assert built[0] is built[1]
    interval = config.generator.opponent_interval
    versions = []
    for iteration in range(interval + 1):
        generator.record(iteration, weights, [goals])
        versions.append(generator.generator.opponents.version)
    assert versions == [opponents.version] * interval + [interval]
    actor.play(weights, snapshot, generator.generator.opponents)
    assert actor._past is not built[0]
    assert len(actor._past) == len(generator.generator.opponents.alice) == config.generator.opponent_pool_size
