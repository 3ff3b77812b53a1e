import numpy as np
import pytest

from service.downstream.learner import make_learner
from service.downstream.methods import find_method
from service.downstream.settings import make_cell, make_sac
from service.downstream.worker import make_worlds

NUM_WORLDS = 40


@pytest.fixture
def explorer(champion):
    """Makes learners that take note of what their worlds do."""
    made = []

    def make(**sac):
        settings = make_sac(num_worlds=NUM_WORLDS, batch_size=4, gradient_steps=1, hidden_sizes=(8,), **sac)
        cell = make_cell(task="push", method="ours", seed=3, num_env_steps=4_000, sac=settings)
        env = make_worlds(cell, find_method("ours"), champion, 1)
        made.append(env)
        return make_learner(cell, find_method("ours"), env)

    yield make
    for env in made:
        env.close()


def actions_of(learner, num_steps):
    """(T, N, K) what was done in so many steps of every world."""
    learner.learn(num_steps * NUM_WORLDS)
    return learner.replay_buffer.actions[:num_steps].copy()


def test_uniform_actions_are_held_before_it_learns(explorer):
    actions = actions_of(explorer(hold_steps=5, learning_starts=10_000), 12)
    changed = (np.diff(actions, axis=0) != 0.0).any(axis=2)
    assert (changed == (np.arange(1, 12) % 5 == 0)[:, None]).all()
    assert abs(actions[::5].mean()) < 0.1
    assert abs(actions[::5].std() - 1 / np.sqrt(3)) < 0.05  # uniform in [-1, 1]


def test_some_worlds_explore_while_it_learns(explorer):
    actions = actions_of(explorer(hold_steps=5, explore_share=0.25, learning_starts=5 * NUM_WORLDS), 55)[5:]
    held = (np.diff(actions.reshape(10, 5, NUM_WORLDS, -1), axis=1) == 0.0).all(axis=(1, 3))
    assert 0.15 < held.mean() < 0.35  # of 400, 0.25 +- 5 standard deviations
    assert not (held == held[0]).all()  # decided anew


def test_without_a_share_only_the_policy_acts(explorer):
    learner = explorer(hold_steps=5, learning_starts=5 * NUM_WORLDS)
    actions = actions_of(learner, 15)[5:]
    assert (np.diff(actions, axis=0) != 0.0).any(axis=2).all()
    assert np.isnan(learner.held).all()
