import numpy as np
import pytest

from service.downstream.learner import make_loop
from service.downstream.methods import METHODS
from service.downstream.worker import make_worlds
from service.envs.observations import layouts
from service.errors import TandemError
from service.primitives.learned import LearnedPolicy, read_policy, save_policy
from tests.downstream.trials import small_trial


def learned(method, champion):
    trial = small_trial(method)
    worlds = make_worlds(trial, METHODS[method], champion, 1)
    loop = make_loop(trial, METHODS[method], champion, worlds)
    loop.play(400)
    return loop, loop.learner.averaged_parameters()


@pytest.mark.parametrize("method", ["ours", "ours-residual-her", "scratch-monolithic", "scratch-mcp-her"])
def test_a_learned_policy_acts_as_in_its_worlds(champion, method, tmp_path):
    """Evaluation goes another way than learning, from Bob's input to actions; a loaded policy does the same."""
    loop, parameters = learned(method, champion)
    save_policy(tmp_path / "policy.safetensors", parameters, method, None)
    saved, frozen = read_policy(tmp_path / "policy.safetensors"), METHODS[method].frozen(champion)
    seen = layouts(champion.config.world)
    players = [LearnedPolicy(each, frozen, seen) for each in (parameters, saved.parameters)]
    inner = loop.worlds.env.env if METHODS[method].composes else loop.worlds.env
    handed, step = [], inner.step
    inner.step = lambda actions: handed.append(actions) or step(actions)
    import torch

    loop.worlds.env.reset(seed=3)
    worlds = type(loop.worlds)(loop.worlds.env, 3)
    for _ in range(3):
        with torch.no_grad():  # this learner has been averaged once: the average is the actor
            actions = torch.tanh(loop.learner.actor(torch.from_numpy(worlds.inputs()))[0]).numpy()
        columns, _ = worlds.step(actions)
        rows = np.concatenate((columns["positions"], columns["goal"]), axis=1)
        for player in players:
            np.testing.assert_allclose(player.act_deterministic(rows), handed[-1], rtol=0, atol=1e-5)
    players[0].begin()
    fresh = METHODS[method].learned(parameters, champion)
    np.testing.assert_array_equal(players[0].act_deterministic(rows), fresh.act_deterministic(rows))
    loop.worlds.close()


def test_what_is_no_policy(tmp_path):
    path = tmp_path / "policy.safetensors"
    with pytest.raises(TandemError, match=r"policy\.safetensors"):
        read_policy(path)
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(TandemError, match="is no policy of a downstream training"):
        read_policy(path)
