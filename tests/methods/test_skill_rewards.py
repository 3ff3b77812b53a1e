"""Each intrinsic reward against numbers computed by hand, on networks whose weights are known."""

import math

import numpy as np
import pytest
import torch

from service.config.skills import SKILLS_OF, SkillsConfig
from service.methods.rewards import find_reward
from service.policies.frozen_skills import draw_skills

BEFORE = torch.tensor([[0.1, 0.2, 0.0], [1.0, -1.0, 0.5], [0.0, 0.0, 0.0]])
AFTER = torch.tensor([[0.1, 0.3, 0.0], [1.0, -1.0, 0.5], [-0.2, 0.0, 0.4]])
SKILL = torch.tensor([[1.0, 0.0], [0.5, -2.0], [-1.0, 1.0]])


def make(method, **settings):
    config = SkillsConfig(method=method, size=2, hidden_sizes=(5,), **settings)
    return find_reward(config.method, {})(config, 3, 0)


def network_of(reward, rows):
    """The network by hand, from its effective weights."""
    first, second = (layer for layer in reward.network if hasattr(layer, "weight"))
    hidden = np.maximum(np.asarray(rows) @ first.weight.detach().numpy().T + first.bias.detach().numpy(), 0.0)
    return hidden @ second.weight.detach().numpy().T + second.bias.detach().numpy()


@pytest.mark.parametrize("method", ["lsd", "metra"])
def test_a_step_in_phi_along_the_skill(method):
    reward = make(method)
    step = network_of(reward, AFTER) - network_of(reward, BEFORE)
    expected = (step * SKILL.numpy()).sum(1)
    np.testing.assert_allclose(reward.rewards(BEFORE, AFTER, SKILL), expected, atol=1e-5)
    assert expected[1] == 0.0  # nothing moved
    assert abs(expected[0]) > 1e-4


def test_diayn_by_hand():
    """log q(z given s') - log p(z), densities of normal distributions."""
    reward = make("diayn")
    mean = network_of(reward, AFTER)
    log_q = (-0.5 * (SKILL.numpy() - mean) ** 2 - 0.5 * math.log(2 * math.pi)).sum(1)
    log_p = (-0.5 * SKILL.numpy() ** 2 - 0.5 * math.log(2 * math.pi)).sum(1)
    np.testing.assert_allclose(reward.rewards(BEFORE, AFTER, SKILL), log_q - log_p, atol=1e-5)


def test_dads_by_hand():
    reward = make("dads", num_alternatives=7)
    rng = np.random.default_rng(0)
    states = torch.from_numpy(rng.standard_normal((6, 3), dtype=np.float32))
    reward.learn(states, states + 0.1, torch.zeros(6, 2))
    before_mean = 0.01 * states.numpy().mean(0)
    before_std = np.sqrt(0.99 + 0.01 * (states.numpy() ** 2).mean(0) - before_mean**2 + 0.001)
    change_mean = 0.01 * 0.1
    change_std = math.sqrt(0.99 + 0.01 * 0.1**2 - change_mean**2 + 0.001)
    state = (BEFORE.numpy() - before_mean) / before_std
    change = ((AFTER - BEFORE).numpy() - change_mean) / change_std
    others = torch.rand((7, 2), generator=torch.Generator().manual_seed(0)).numpy() * 2 - 1

    def log_q(skills):
        mean = network_of(reward, np.concatenate((state, skills), 1))
        return -0.5 * ((change - mean) ** 2).sum(1)

    own = log_q(SKILL.numpy())
    total = sum(np.exp(np.clip(log_q(np.tile(each, (3, 1))) - own, -50, 50)) for each in others)
    found = reward.rewards(BEFORE, AFTER, SKILL)
    np.testing.assert_allclose(found, math.log(8) - np.log(1 + total), atol=1e-5)


def test_dads_pays_a_large_batch_as_its_parts():
    """All transitions are compared with the same alternatives, however many are predicted at once."""
    rows = torch.randn((70, 8), generator=torch.Generator().manual_seed(1)).split((3, 3, 2), dim=1)
    paid = make("dads", num_alternatives=5).rewards(*rows)
    for first in (0, 31, 32, 64, 69):
        alone = make("dads", num_alternatives=5).rewards(*(each[first : first + 1] for each in rows))
        np.testing.assert_allclose(paid[first], alone[0], rtol=1e-5)
    assert len(paid) == 70


def test_dads_clips_what_is_certain():
    reward = make("dads", num_alternatives=1)
    reward._log_prob = lambda state, change, skill: torch.full(state.shape[:-1], -300.0 if state.dim() == 3 else 0.0)
    np.testing.assert_allclose(reward.rewards(BEFORE, AFTER, SKILL), math.log(2))  # and not minus infinity inside
    reward._log_prob = lambda state, change, skill: torch.full(state.shape[:-1], 300.0 if state.dim() == 3 else 0.0)
    np.testing.assert_allclose(reward.rewards(BEFORE, AFTER, SKILL), math.log(2) - 50.0, rtol=1e-5)


def test_lsd_is_1_lipschitz_and_stays_so():
    reward = make("lsd", learning_rate=0.05)
    rng = np.random.default_rng(0)
    for _ in range(200):
        before = torch.from_numpy(rng.standard_normal((32, 3), dtype=np.float32))
        skill = torch.from_numpy(rng.standard_normal((32, 2), dtype=np.float32))
        reward.learn(before, before + 0.3 * skill @ torch.eye(2, 3), skill)
    one, other = (torch.from_numpy(rng.standard_normal((500, 3), dtype=np.float32)) for _ in range(2))
    with torch.no_grad():
        steps = (reward.network(one) - reward.network(other)).norm(dim=1) / (one - other).norm(dim=1)
    assert steps.max() <= 1.0 + 1e-2
    assert steps.max() > 0.7  # and uses what it may


def test_metra_by_hand():
    reward = make("metra", dual_initial=3.0, learning_rate=0.1)
    before = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    after = torch.tensor([[0.01, 0.0, 0.0], [40.0, 40.0, -40.0]])
    skill = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    step = network_of(reward, after) - network_of(reward, before)
    room = np.minimum(1.0 - (step**2).mean(1), 0.001)
    assert room[0] == 0.001
    assert room[1] < -1.0
    expected = -((step * skill.numpy()).sum(1) + 3.0 * room).mean() + math.log(3.0) * room.mean()
    assert reward.learn(before, after, skill) == pytest.approx(expected, rel=1e-4)
    assert reward._log_dual.item() == pytest.approx(math.log(3.0) + 0.1)  # too far: the dual variable rises
    near = reward.learn(before, before + 1e-4, skill)
    assert math.isfinite(near)


def test_the_duals_loss_moves_no_weight_of_phi_and_phis_not_the_dual():
    reward = make("metra")
    loss = reward.loss(BEFORE, AFTER, SKILL)
    (gradient,) = torch.autograd.grad(loss, reward._log_dual)
    step = network_of(reward, AFTER) - network_of(reward, BEFORE)
    assert gradient.item() == pytest.approx(np.minimum(1.0 - (step**2).mean(1), 1e-3).mean(), rel=1e-4)


def test_csf_by_hand():
    reward = make("csf")
    step = network_of(reward, AFTER) - network_of(reward, BEFORE)
    np.testing.assert_allclose(reward.rewards(BEFORE, AFTER, SKILL), step, atol=1e-5)
    scores = step @ SKILL.numpy().T
    expected = (5.0 * np.log(np.exp(scores).mean(1)) - np.diag(scores)).mean()
    assert reward.learn(BEFORE, AFTER, SKILL) == pytest.approx(expected, rel=1e-4)


def test_what_is_known_without_the_classes_is_what_they_say():
    found = {name: find_reward(name, {}) for name in SKILLS_OF}
    assert {name: (each.prior, each.zero_shot) for name, each in found.items()} == SKILLS_OF


def test_priors():
    rng = np.random.default_rng(0)
    drawn = {name: draw_skills(SKILLS_OF[name][0], 4000, 3, rng) for name in SKILLS_OF}
    assert all(skills.shape == (4000, 3) and skills.dtype == np.float32 for skills in drawn.values())
    for name in ("lsd", "diayn"):
        assert drawn[name].std() == pytest.approx(1.0, abs=0.03)
    np.testing.assert_allclose(np.linalg.norm(drawn["metra"], axis=1), 1.0, rtol=1e-5)
    assert abs(drawn["metra"].mean(0)).max() < 0.05
    assert abs(drawn["dads"]).max() <= 1.0
    assert drawn["dads"].std() == pytest.approx(1 / math.sqrt(3), abs=0.02)


@pytest.mark.parametrize("method", SKILLS_OF)
def test_it_continues_bit_for_bit_where_it_was_saved(method):
    first, second = make(method), find_reward(method, {})(SkillsConfig(method=method, size=2, hidden_sizes=(5,)), 3, 7)
    first.learn(BEFORE, AFTER, SKILL)
    first.rewards(BEFORE, AFTER, SKILL)
    second.load_state(first.state())
    exported = first.exported()  # as a checkpoint's skills are, after its state
    assert all(np.array_equal(array, second.exported()[name]) for name, array in exported.items())
    first.exported()
    for reward in (first, second):
        reward.learn(AFTER, BEFORE, SKILL)
    np.testing.assert_array_equal(*(reward.rewards(BEFORE, AFTER, SKILL) for reward in (first, second)))
    one, other = first.state(), second.state()
    assert one.keys() == other.keys()
    assert all(np.array_equal(array, other[name]) for name, array in one.items())
