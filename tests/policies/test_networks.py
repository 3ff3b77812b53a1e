"""The torch networks: who sees what, bounds, initial values."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from service.config.self_play import MCPConfig, PolicyConfig
from service.envs.observations import ACTION, BOB, PAPER, POSITIONS
from service.policies.gaussian import log_prob
from service.policies.networks import (
    GaussianPolicy,
    MCPPolicy,
    ValueNetwork,
    elu,
    export_parameters,
    make_alice,
    make_bob,
)
from service.policies.parameters import FloatArray

Observe = Callable[[int, int], FloatArray]
ULP = 1e-6


@pytest.fixture
def seeded() -> None:
    torch.manual_seed(0)


def test_shapes(alice: GaussianPolicy, bob: MCPPolicy, config: PolicyConfig) -> None:
    for policy, size in ((alice, PAPER.full.size), (bob, BOB.size)):
        for batch in ((), (5,), (2, 5)):
            mean, std = policy(torch.zeros(*batch, size))
            assert mean.shape == std.shape == (*batch, ACTION.size)
            assert mean.dtype == torch.float32
    means, variances = bob.primitives(torch.zeros(2, 5, POSITIONS.size))
    assert means.shape == variances.shape == (2, 5, config.bob.num_primitives, ACTION.size)
    assert ValueNetwork(PAPER.full.normalisation, config.value)(torch.zeros(2, 5, PAPER.full.size)).shape == (2, 5)
    assert ValueNetwork(PAPER.bob_value.normalisation, config.value)(torch.zeros(2, 5, PAPER.bob_value.size)).shape == (
        2,
        5,
    )


def test_goal_reaches_only_the_gate(bob: MCPPolicy, observe: Observe) -> None:
    rows = torch.tensor(observe(20, BOB.size), requires_grad=True)
    moved = rows.detach().clone()
    moved[:, BOB["goal"]] += 0.1
    parts: list[tuple[torch.Tensor, torch.Tensor]] = []
    bob.primitives.register_forward_hook(lambda _module, _inputs, output: parts.append(output))
    bob(rows)
    bob(moved)
    for before, after in zip(*parts, strict=True):
        assert torch.equal(before, after)
        (gradient,) = torch.autograd.grad(before.sum(), rows, retain_graph=True)
        assert (gradient[:, BOB["goal"]] == 0.0).all()
        assert (gradient[:, : POSITIONS.size] != 0.0).any()
    assert (bob.gate(rows) - bob.gate(moved)).abs().max() > 1e-3


def test_gate_sees_the_goal_relative_to_the_object_on_its_own_scale(bob: MCPPolicy) -> None:
    seen: list[torch.Tensor] = []
    bob.gate.input.register_forward_hook(lambda _module, _inputs, output: seen.append(output))
    row = torch.zeros(BOB.size)
    row[5:8] = torch.tensor([0.01, 0.02, 0.03])
    row[11:14] = torch.tensor([0.06, -0.03, 0.03])
    bob.gate(row)
    np.testing.assert_allclose(seen[0][-3:], [0.5, -0.5, 0.0], atol=1e-6)


def test_every_primitive_is_the_network_written_out(bob: MCPPolicy, config: PolicyConfig, observe: Observe) -> None:
    positions = torch.tensor(observe(20, POSITIONS.size))
    means, variances = bob.primitives(positions)
    head = config.bob.primitive_hidden_size
    for index in range(config.bob.num_primitives):
        block = slice(index * head, (index + 1) * head)
        trunk = bob.primitives.trunk(bob.primitives.input(positions))
        hidden = torch.nn.functional.elu(
            trunk @ bob.primitives.hidden.weight[block].T + bob.primitives.hidden.bias[block]
        )
        output = hidden @ bob.primitives.output_weight[index] + bob.primitives.output_bias[index]
        low, high = config.bob.log_std_min, config.bob.log_std_max
        log_std = low + (high - low) / (1.0 + torch.exp(-output[:, 4:]))
        torch.testing.assert_close(means[:, index], 2.0 * torch.tanh(output[:, :4] / 2.0), atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(variances[:, index], torch.exp(log_std) ** 2, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("magnitude", [1.0, 1e6, 1e30, float("inf")])
def test_outputs_are_bounded_for_any_input(
    alice: GaussianPolicy, bob: MCPPolicy, config: PolicyConfig, magnitude: float
) -> None:
    signs = torch.tensor(np.random.default_rng(0).choice([-1.0, 1.0], (64, PAPER.full.size)), dtype=torch.float32)
    mean, std = alice(magnitude * signs)
    assert (mean.abs() <= 2.0).all()
    assert (std.log() >= config.alice_log_std_min - ULP).all()
    assert (std.log() <= config.alice_log_std_max + ULP).all()
    if math.isinf(magnitude):
        return  # goal - object of two infinities is no number
    rows = magnitude * signs[:, : BOB.size]
    weights = bob.gate(rows)
    assert (weights >= config.bob.weight_floor - ULP).all()
    assert (weights <= 1.0 + ULP).all()
    mean, std = bob(rows)
    assert (mean.abs() <= 2.0 + ULP).all()
    least = config.bob.log_std_min - 0.5 * math.log(config.bob.num_primitives)
    most = config.bob.log_std_max - 0.5 * math.log(config.bob.num_primitives * config.bob.weight_floor)
    assert (std.log() >= least - 1e-5).all()
    assert (std.log() <= most + 1e-5).all()


def test_saturated_outputs_reach_their_bounds_and_no_further() -> None:
    policy = make_bob(PolicyConfig())
    with torch.no_grad():
        policy.primitives.output_bias.fill_(1e6)
        policy.gate.output.bias.fill_(-1e6)
    means, variances = policy.primitives(torch.zeros(POSITIONS.size))
    np.testing.assert_allclose(means.detach(), 2.0)
    np.testing.assert_allclose(variances.detach(), math.exp(2 * 0.5), rtol=1e-6)
    np.testing.assert_allclose(policy.gate(torch.zeros(BOB.size)).detach(), 0.01, rtol=1e-6)


@pytest.mark.parametrize("num_primitives", [1, 2, 4])  # more would need wider primitives than log_std_max allows
@pytest.mark.usefixtures("seeded")
def test_initial_players_explore_with_the_stated_std(num_primitives: int) -> None:
    config = PolicyConfig(bob=MCPConfig(num_primitives=num_primitives))
    rng = np.random.default_rng(0)
    full, bob_rows = (
        torch.tensor(layout.offset + layout.scale * rng.standard_normal((500, len(layout.offset))), dtype=torch.float32)
        for layout in (PAPER.full.normalisation, BOB.normalisation)
    )
    mean, std = make_alice(config)(full)
    assert mean.abs().max() < 0.1
    np.testing.assert_allclose(std.detach(), math.exp(-0.1), rtol=0.02)
    bob = make_bob(config)
    mean, std = bob(bob_rows)
    assert mean.abs().mean() < 0.3
    assert abs(std.mean().item() - 0.9) < 0.08
    with torch.no_grad():
        bob.gate.output.weight.zero_()
    np.testing.assert_allclose(bob(bob_rows)[1].detach(), math.exp(-0.1), rtol=0.02)


@pytest.mark.usefixtures("seeded")
def test_initial_primitives_and_weights_differ() -> None:
    bob = make_bob(PolicyConfig())
    rows = torch.tensor(BOB.normalisation.offset) + torch.randn(500, BOB.size) * torch.tensor(BOB.normalisation.scale)
    means, _ = bob.primitives(rows[:, : POSITIONS.size])
    weights = bob.gate(rows)
    assert means.std(dim=1).mean() > 0.05
    assert weights.std(dim=1).mean() > 0.05
    assert abs(weights.mean().item() - 0.5) < 0.2


@pytest.mark.usefixtures("seeded")
def test_initial_values_are_near_zero() -> None:
    for layout in (PAPER.full, PAPER.bob_value):
        value = ValueNetwork(layout.normalisation, PolicyConfig().value)
        assert value(torch.randn(100, layout.size)).abs().max() < 0.1


def test_log_prob_has_a_gradient_for_every_parameter(alice: GaussianPolicy, bob: MCPPolicy, observe: Observe) -> None:
    for policy, size in ((alice, PAPER.full.size), (bob, BOB.size)):
        mean, std = policy(torch.tensor(observe(50, size)))
        log_prob(mean.detach() + 0.5, mean, std).mean().backward()
        for name, parameter in policy.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name
            assert (parameter.grad != 0.0).any(), name


def test_export_copies_parameters_and_constants(bob: MCPPolicy) -> None:
    exported = export_parameters(bob)
    assert exported.keys() == bob.state_dict().keys()
    assert {"gate.weight_floor", "primitives.squash.log_std_min", "primitives.input.scale"} <= exported.keys()
    assert all(value.dtype == np.float32 for value in exported.values())
    before = exported["gate.output.bias"].copy()
    with torch.no_grad():
        bob.gate.output.bias.add_(1.0)
    np.testing.assert_array_equal(exported["gate.output.bias"], before)


def test_elu_is_torchs_with_its_gradient() -> None:
    values = torch.cat((torch.linspace(-30.0, 30.0, 1001), torch.tensor([0.0, -0.0, -1e-6, 1e-6])))
    ours, torchs = (values.clone().requires_grad_() for _ in range(2))
    result, expected = elu(ours), torch.nn.functional.elu(torchs)
    np.testing.assert_allclose(result.detach(), expected.detach(), atol=1.2e-7)
    weights = torch.linspace(-1.0, 2.0, len(values))
    (result * weights).sum().backward()
    (expected * weights).sum().backward()
    assert ours.grad is not None
    assert torchs.grad is not None
    np.testing.assert_allclose(ours.grad, torchs.grad, atol=3e-7)
    assert torch.equal(elu(torch.tensor([torch.nan, torch.inf])).isnan(), torch.tensor([True, False]))
