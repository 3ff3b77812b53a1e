import math

import numpy as np
import pytest
import torch

from service.config.self_play import MCPConfig
from service.learner.sac_networks import Critics, GaussianActor, MCPActor, sample_actions
from service.policies.networks import export_parameters
from service.policies.numpy_actor import numpy_actor
from service.policies.parameters import PolicyError

SIZES = MCPConfig(trunk_hidden_sizes=(9,), primitive_hidden_size=6, gate_hidden_sizes=(8, 7))


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
        ("gaussian", {"layers.2.bias": np.zeros(3, np.float32)}, r"'layers\.2\.bias': expected shape \(7,\)"),
        ("gaussian", {"layers.4.weight": None}, r"'layers\.4\.bias': expected none of that name"),
        ("gaussian", {"layers.0.weight": None}, r"'layers\.0\.weight' is missing"),
        ("mcp", {"gate.4.weight": np.zeros((3, 7), np.float32)}, r"'gate\.4\.weight': expected shape \(4, 7\)"),
        ("mcp", {"weight_floor": None}, "'weight_floor' is missing"),
    ],
)
def test_parameters_that_do_not_fit_are_refused(kind, change, words):
    parameters = export_parameters(actors()[kind]) | change
    with pytest.raises(PolicyError, match=words):
        numpy_actor({name: each for name, each in parameters.items() if each is not None})
