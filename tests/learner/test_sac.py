import copy
import math

import numpy as np
import pytest
import torch

from service.config.self_play import MCPConfig
from service.config.skills import SACConfig
from service.learner.off_policy import actions_at_random
from service.learner.sac import Batch, SACLearner, wide_products
from service.learner.sac_networks import Critics, GaussianActor, MCPActor, sample_actions
from service.policies.networks import export_parameters
from service.policies.numpy_actor import numpy_actor
from service.policies.parameters import PolicyError

CONFIG = SACConfig(batch_size=6, gradient_steps=2, hidden_sizes=(8,), learning_rate=0.01, gamma=0.9, tau=0.2)
SMALL = CONFIG.model_copy(update={"gradient_steps": 1})
SIZES = MCPConfig(trunk_hidden_sizes=(9,), primitive_hidden_size=6, gate_hidden_sizes=(8, 7))


def make_learner(config=CONFIG, seed=0):
    torch.manual_seed(seed)
    return SACLearner(GaussianActor(3, 2, config.hidden_sizes), 3, 2, config, seed)


def make_batch(config=CONFIG, seed=0):
    rng, size = np.random.default_rng(seed), config.gradient_steps * config.batch_size
    draw = lambda *shape: rng.standard_normal(shape, dtype=np.float32)  # noqa: E731
    return Batch(draw(size, 3), np.tanh(draw(size, 2)), draw(size), draw(size, 3))


def test_one_step_by_hand():
    """Losses of Haarnoja et al. 2018, the order of the gradients, and what each of them reaches."""
    learner, batch = make_learner(SMALL), make_batch(SMALL)
    before = copy.deepcopy(learner)
    noise = torch.Generator()
    noise.set_state(learner._random.get_state())
    found = learner.update(batch)
    inputs, actions, rewards, next_inputs = map(torch.from_numpy, batch[:4])
    with torch.no_grad():
        mean, log_std = before.actor(next_inputs)
        next_actions, log_prob = sample_actions(mean, log_std, torch.randn(6, 2, generator=noise))
        following = before._targets(next_inputs, next_actions).min(0).values
        target = rewards + 0.9 * (following - 0.1 * log_prob)
    assert found["entropy_coefficient"] == pytest.approx(0.1)
    loss = sum(0.5 * ((value - target) ** 2).mean() for value in before.critics(inputs, actions))
    assert found["critic_loss"] == pytest.approx(loss.item(), rel=1e-5)
    parameters = list(before.critics.parameters())
    for old, gradient, new in zip(
        parameters, torch.autograd.grad(loss, parameters), learner.critics.parameters(), strict=True
    ):
        # the first step of Adam: the learning rate, against the sign of the gradient
        moved = torch.where(gradient.abs() > 1e-5, -0.01 * gradient.sign(), new.detach() - old.detach())
        torch.testing.assert_close(new.detach() - old.detach(), moved, rtol=2e-3, atol=1e-6)
    mean, log_std = before.actor(inputs)
    new_actions, log_prob = sample_actions(mean, log_std, torch.randn(6, 2, generator=noise))
    actor_loss = (0.1 * log_prob - learner.critics(inputs, new_actions).min(0).values).mean()  # of the new critics
    assert found["actor_loss"] == pytest.approx(actor_loss.item(), rel=1e-5)
    assert found["entropy"] == pytest.approx(-log_prob.mean().item(), rel=1e-5)
    # entropy above the target of -2 makes the coefficient fall
    step = learner._log_alpha.item() - before._log_alpha.item()
    assert step == pytest.approx(-0.01 * np.sign(found["entropy"] + 2.0), rel=1e-4)
    for old, target_now, critic in zip(
        before._targets.parameters(), learner._targets.parameters(), learner.critics.parameters(), strict=True
    ):
        torch.testing.assert_close(target_now, 0.8 * old + 0.2 * critic.detach())


def test_every_step_has_rows_of_its_own():
    batch = make_batch()
    both, one_by_one = make_learner(), make_learner()
    both.update(batch)
    for rows in (slice(0, 6), slice(6, 12)):
        one_by_one.update(Batch(*(column[rows] for column in batch[:4])))
    for one, other in zip(both.actor.parameters(), one_by_one.actor.parameters(), strict=True):
        assert torch.equal(one, other)


def test_successor_features_by_hand():
    """Of two critics the one whose features are worth less under the weights; without what entropy is worth later."""
    learner = SACLearner(GaussianActor(3, 2, SMALL.hidden_sizes), 3, 2, SMALL, 0, 4)
    rows = make_batch(SMALL)
    rng = np.random.default_rng(1)
    features, weights = (rng.standard_normal((6, 4)).astype(np.float32) for _ in range(2))
    before = copy.deepcopy(learner)
    noise = torch.Generator()
    noise.set_state(learner._random.get_state())
    found = learner.update(rows._replace(rewards=features, weights=weights))
    inputs, actions, _, next_inputs = map(torch.from_numpy, rows[:4])
    with torch.no_grad():
        next_actions, _ = sample_actions(*before.actor(next_inputs), torch.randn(6, 2, generator=noise))
        first, second = before._targets(next_inputs, next_actions).numpy()
    lower = np.where(((first * weights).sum(1) <= (second * weights).sum(1))[:, None], first, second)
    assert not np.array_equal(lower, np.minimum(first, second))
    target = features + 0.9 * lower
    values = before.critics(inputs, actions).detach().numpy()
    assert found["critic_loss"] == pytest.approx(
        sum(0.5 * ((value - target) ** 2).mean() for value in values), rel=1e-5
    )
    mean, log_std = before.actor(inputs)
    new_actions, log_prob = sample_actions(mean, log_std, torch.randn(6, 2, generator=noise))
    worth = (learner.critics(inputs, new_actions).detach().numpy() * weights).sum(2).min(0)
    assert found["actor_loss"] == pytest.approx((0.1 * log_prob.detach().numpy() - worth).mean(), rel=1e-5)


def test_it_finds_the_better_action():
    """Rewarded is an action near 0.5, whatever the input: the mean action goes there."""
    config = CONFIG.model_copy(update={"batch_size": 64, "hidden_sizes": (32,), "tau": 0.05, "gradient_steps": 400})
    learner, rng = make_learner(config), np.random.default_rng(0)
    size = config.gradient_steps * config.batch_size
    inputs, actions = rng.standard_normal((size, 3), dtype=np.float32), rng.uniform(-1, 1, (size, 2)).astype(np.float32)
    rewards = -5.0 * np.square(actions - 0.5).sum(1)
    learner.update(Batch(inputs, actions, rewards, inputs))
    with torch.no_grad():
        found = torch.tanh(learner.actor(torch.from_numpy(inputs[:200]))[0])
    np.testing.assert_allclose(found.mean(0), 0.5, atol=0.15)  # entropy pulls towards the middle


def test_sampled_actions_follow_the_actor():
    learner = make_learner()
    inputs = np.tile(np.float32([[0.3, -0.2, 1.0]]), (20_000, 1))
    with torch.no_grad():
        mean, log_std = learner.actor(torch.from_numpy(inputs[:1]))
    before = np.arctanh(learner.act(inputs).astype(np.float64))
    np.testing.assert_allclose(before.mean(0), mean[0], atol=0.03)
    np.testing.assert_allclose(before.std(0), log_std.exp()[0], rtol=0.03)


def test_actions_at_random_are_uniform():
    actions = actions_at_random((1000, 4), np.random.default_rng(0))
    assert actions.dtype == np.float32
    assert actions.shape == (1000, 4)
    assert -1.0 <= actions.min() < -0.99
    assert 0.99 < actions.max() <= 1.0
    np.testing.assert_allclose(actions.mean(0), 0.0, atol=0.06)  # three standard errors: 3 / sqrt(3 * 1000)


def test_the_average_of_the_actor():
    """Keep 0, 1/9 and 2/10 of what was."""
    learner, expected = make_learner(), 0.0
    for keep in (0.0, 1 / 9, 0.2):
        learner.update(make_batch())
        learner.average_actor()
        now = learner.actor.layers[0].weight.detach().numpy()
        expected = keep * expected + (1 - keep) * now
        np.testing.assert_allclose(learner.averaged_parameters()["layers.0.weight"], expected, atol=1e-6)
    assert not np.array_equal(expected, now)


def test_it_continues_bit_for_bit_where_it_was_saved():
    first, second = make_learner(), make_learner(seed=5)
    first.update(make_batch())
    first.average_actor()
    saved = copy.deepcopy(first.state())
    second.load_state(saved)
    for learner in (first, second):
        learner.update(make_batch(seed=1))
        learner.average_actor()
        learner.act(np.zeros((2, 3), np.float32))
    one, other = first.state(), second.state()
    assert one.keys() == other.keys() == saved.keys()
    assert all(np.array_equal(array, other[name]) for name, array in one.items())
    same = [name for name, array in one.items() if np.array_equal(array, saved[name])]
    assert same == []


def test_what_else_draws_random_numbers_does_not_matter():
    first = make_learner()
    first.update(make_batch())
    torch.rand(10)
    second = make_learner()
    torch.rand(10)
    second.update(make_batch())
    assert all(np.array_equal(array, second.state()[name]) for name, array in first.state().items())


def actors():
    torch.manual_seed(0)
    return {"gaussian": GaussianActor(5, 3, (8, 7)), "mcp": MCPActor(2, 5, 3, SIZES)}


def test_an_action_and_its_log_probability_by_hand():
    mean, log_std, noise = torch.tensor([[0.3, -1.0]]), torch.tensor([[math.log(0.5), 0.0]]), torch.tensor([[1.0, 0.5]])
    actions, log_prob = sample_actions(mean, log_std, noise)
    before = np.array([0.3 + 0.5, -1.0 + 0.5])
    np.testing.assert_allclose(actions[0], np.tanh(before), rtol=1e-6)
    density = [math.exp(-0.5) / (0.5 * math.sqrt(2 * math.pi)), math.exp(-0.125) / math.sqrt(2 * math.pi)]
    expected = sum(math.log(each / (1 - math.tanh(u) ** 2)) for each, u in zip(density, before, strict=True))
    assert log_prob.item() == pytest.approx(expected, rel=1e-6)


def test_log_probabilities_stay_finite_where_the_tanh_is_flat():
    mean = torch.full((1, 1), 30.0, requires_grad=True)
    actions, log_prob = sample_actions(mean, torch.zeros(1, 1), torch.zeros(1, 1))
    assert actions.item() == 1.0
    assert log_prob.item() == pytest.approx(60.0 - 2 * math.log(2) - 0.5 * math.log(2 * math.pi), rel=1e-6)
    assert torch.autograd.grad(log_prob, mean)[0].item() == pytest.approx(2.0)


def test_the_two_critics_are_two():
    critics = Critics(5, 3, (8,))
    inputs, actions = torch.randn(4, 5), torch.randn(4, 3)
    values = critics(inputs, actions)
    assert values.shape == (2, 4)
    rows = torch.cat((inputs, actions), 1)
    for value, network in zip(values, (critics.first, critics.second), strict=True):
        hidden = torch.relu(rows @ network[0].weight.T + network[0].bias)
        torch.testing.assert_close(value, (hidden @ network[2].weight.T + network[2].bias)[:, 0])
    assert not torch.equal(values[0], values[1])


def test_critics_with_normalised_hidden_layers_by_hand():
    critics = Critics(5, 3, (8, 6), layer_norm=True)
    inputs, actions = torch.randn(4, 5), torch.randn(4, 3)
    hidden = torch.cat((inputs, actions), 1)
    first, norm, _, second, other_norm, _, last = critics.first
    for layer, scale in ((first, norm), (second, other_norm)):
        hidden = hidden @ layer.weight.T + layer.bias
        mean, variance = hidden.mean(1, keepdim=True), hidden.var(1, keepdim=True, unbiased=False)
        hidden = torch.relu((hidden - mean) / (variance + 1e-5).sqrt() * scale.weight + scale.bias)
    torch.testing.assert_close(critics(inputs, actions)[0], (hidden @ last.weight.T + last.bias)[:, 0])


def test_the_mcp_actor_is_the_product_of_its_primitives_by_hand():
    actor, inputs = actors()["mcp"], torch.randn(4, 5)
    mean, log_std = (each.detach().numpy() for each in actor(inputs))
    with torch.no_grad():
        hidden = torch.relu(actor.primitives(inputs[:, :2])).reshape(4, 4, 6)
        gate = actor.gate(inputs).numpy()
        for row in range(4):
            precision, weighted = np.zeros(3), np.zeros(3)
            for k in range(4):
                output = (hidden[row, k] @ actor.output_weight[k] + actor.output_bias[k]).numpy()
                weight = 0.01 + 0.99 / (1.0 + math.exp(-gate[row, k]))
                share = weight / np.exp(np.clip(output[3:], -5.0, 2.0)) ** 2
                precision, weighted = precision + share, weighted + share * output[:3]
            np.testing.assert_allclose(mean[row], weighted / precision, rtol=1e-5)
            np.testing.assert_allclose(log_std[row], -0.5 * np.log(precision), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["gaussian", "mcp"])
def test_numpy_acts_as_torch_does(kind):
    actor, inputs = actors()[kind], torch.randn(20, 5)
    with torch.no_grad():
        expected = torch.tanh(actor(inputs)[0])
    found = numpy_actor(export_parameters(actor))
    assert (found.num_inputs, found.num_actions) == (5, 3)
    np.testing.assert_allclose(found(inputs.numpy()), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "change", "words"),
    [
        ("gaussian", {"layers.2.bias": np.zeros(3, np.float32)}, "do not fit together"),
        ("gaussian", {"layers.0.weight": None}, r"KeyError: 'layers\.0\.weight'"),
        ("mcp", {"gate.4.weight": np.zeros((3, 7), np.float32)}, "do not fit together"),
        ("mcp", {"weight_floor": None}, "KeyError: 'weight_floor'"),
    ],
)
def test_parameters_that_do_not_fit_are_refused(kind, change, words):
    parameters = export_parameters(actors()[kind]) | change
    with pytest.raises(PolicyError, match=words):
        numpy_actor({name: each for name, each in parameters.items() if each is not None})


def test_products_are_of_float32_and_others_stay_as_they_are():
    first, second = torch.randn(64, 64), torch.randn(64, 64)
    exact = first.double() @ second.double()
    before = torch.backends.mkldnn.matmul.fp32_precision
    with wide_products():
        assert (first @ second - exact).abs().max() < 1e-4  # bfloat16 has 0.1
    assert torch.backends.mkldnn.matmul.fp32_precision == before
