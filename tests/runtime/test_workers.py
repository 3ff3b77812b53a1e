"""The workers of both runners: the random numbers of an actor go to the task generator and come back advanced."""

from copy import deepcopy

import numpy as np
import pytest

from service.actors.self_play import SelfPlay
from service.runtime.workers import GeneratorWorker, LearnerWorker, RolloutWorker
from tests.runtime.runs import tiny_config


@pytest.fixture
def config():
    return tiny_config()


@pytest.fixture
def actor(config):
    worker = RolloutWorker(config, num_threads=1)
    yield worker
    worker.game.close()


def watch(monkeypatch, name):
    """Random states with which one of ``SelfPlay``'s turns begins."""
    states, play = [], getattr(SelfPlay, name)

    def watched(self, *arguments):
        states.append(deepcopy(self._rng.bit_generator.state))
        return play(self, *arguments)

    monkeypatch.setattr(SelfPlay, name, watched)
    return states


def test_both_turns_go_on_with_the_random_numbers_that_come_back(config, actor, monkeypatch):
    alice, bob = watch(monkeypatch, "_play_alice"), watch(monkeypatch, "_play_bob")
    generator, weights = GeneratorWorker(config), LearnerWorker(config).learner.weights()
    returned = []

    def choose_goals(plan, proposals, rng):
        choice, rng = generator.choose_goals(plan, proposals, rng)
        rng.random(7)
        returned.append(rng.bit_generator.state)
        return choice, rng

    assignment = generator.assign(config.game.num_worlds, actor.rng, actor.pool_version)
    assignment.rng.random(5)
    actor.play(weights, assignment, choose_goals)
    assert alice == [assignment.rng.bit_generator.state]
    assert bob == returned


def test_the_generator_leaves_the_random_numbers_it_is_given(config, actor):
    generator = GeneratorWorker(config)
    given = np.random.default_rng(3)
    before = deepcopy(given.bit_generator.state)
    generator.generator.add_opponents(*[{"x": np.zeros(1, np.float32)}] * 2)
    assignment = generator.assign(config.game.num_worlds, given, -1)
    assert given.bit_generator.state == before != assignment.rng.bit_generator.state


def test_opponents_are_shipped_once(config, actor):
    generator = GeneratorWorker(config)
    first = generator.assign(8, actor.rng, -1)
    assert first.pool is generator.generator.opponents
    assert generator.assign(8, actor.rng, first.pool_version).pool is None
