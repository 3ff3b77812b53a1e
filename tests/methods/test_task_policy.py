import numpy as np
import pytest
import torch

from service.config.task_methods import TASK_METHODS
from service.methods.task import TaskLearning
from tests.methods.trials import small_trial


@pytest.mark.parametrize("method", ["ours", "ours-residual-her", "scratch-monolithic", "scratch-mcp-her"])
def test_a_learned_policy_acts_as_in_its_worlds(champion, method):
    """Evaluation goes another way than learning, from Bob's input to actions; a loaded policy does the same."""
    training = TaskLearning(small_trial(method).begin("no registry here", None), champion)
    loop = training.loop
    loop.play(400)
    player = training.player()
    inner = loop.worlds.env.env if TASK_METHODS[method].composes else loop.worlds.env
    handed, step = [], inner.step
    inner.step = lambda actions: handed.append(actions) or step(actions)
    loop.worlds.env.reset(seed=3)
    worlds = type(loop.worlds)(loop.worlds.env, 3)
    for _ in range(3):
        with torch.no_grad():  # this learner has been averaged once: the average is the actor
            actions = torch.tanh(loop.learner.actor(torch.from_numpy(worlds.inputs()))[0]).numpy()
        columns, _ = worlds.step(actions)
        rows = np.concatenate((columns["positions"], columns["goal"]), axis=1)
        np.testing.assert_allclose(player.act_deterministic(rows), handed[-1], rtol=0, atol=1e-5)
    player.begin()
    np.testing.assert_array_equal(player.act_deterministic(rows), training.player().act_deterministic(rows))
    loop.worlds.close()
