"""The NumPy policies: equal to torch, sampling, independence of rows, broken parameters, no torch."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from service.config.self_play import PolicyConfig
from service.envs.observations import BOB, PAPER, POSITIONS
from service.policies import forward, gaussian
from service.policies.networks import GaussianPolicy, MCPPolicy, export_parameters, make_alice, make_bob
from service.policies.numpy_policy import NumpyGaussianPolicy, NumpyMCPPolicy
from service.policies.parameters import FloatArray, Parameters, PolicyError

Observe = Callable[[int, int], FloatArray]
Players = list[tuple[NumpyGaussianPolicy | NumpyMCPPolicy, GaussianPolicy | MCPPolicy, int]]


@pytest.fixture
def players(alice: GaussianPolicy, bob: MCPPolicy) -> Players:
    """NumPy policy, network and observation size of both players."""
    return [
        (NumpyGaussianPolicy(export_parameters(alice)), alice, PAPER.full.size),
        (NumpyMCPPolicy(export_parameters(bob)), bob, BOB.size),
    ]


def _close(actual: FloatArray, expected: torch.Tensor | FloatArray) -> None:
    assert actual.dtype == np.float32
    np.testing.assert_allclose(actual, torch.as_tensor(expected).detach(), atol=1e-5, rtol=1e-5)


def test_distribution_equals_torch(players: Players, observe: Observe) -> None:
    for numpy_policy, policy, size in players:
        rows = observe(160, size)
        for batch in (rows, rows[3], rows.reshape(4, 40, size), 1e6 * rows):
            mean, std = numpy_policy.distribution(batch)
            expected_mean, expected_std = policy(torch.tensor(batch))
            _close(mean, expected_mean)
            _close(std, expected_std)
            np.testing.assert_array_equal(numpy_policy.act_deterministic(batch), mean)


def test_primitives_gate_and_compose_equal_torch(bob: MCPPolicy, config: PolicyConfig, observe: Observe) -> None:
    numpy_policy = NumpyMCPPolicy(export_parameters(bob))
    assert numpy_policy.num_primitives == config.bob.num_primitives
    rows = observe(60, BOB.size).reshape(3, 20, BOB.size)
    positions = rows[..., : POSITIONS.size]
    means, variances = numpy_policy.primitives(positions)
    expected_means, expected_variances = bob.primitives(torch.tensor(positions))
    _close(means, expected_means)
    _close(variances, expected_variances)
    weights = numpy_policy.gate(rows)
    _close(weights, bob.gate(torch.tensor(rows)))
    for actual, expected in zip(numpy_policy.compose(positions, weights), numpy_policy.distribution(rows), strict=True):
        np.testing.assert_array_equal(actual, expected)
    exported = forward.bob(np, numpy_policy.network, numpy_policy.columns, rows[0])
    _close(exported["action"], numpy_policy.act_deterministic(rows[0]).clip(-1.0, 1.0))


def test_act_samples_the_distribution_and_its_log_prob(players: Players, observe: Observe) -> None:
    for numpy_policy, policy, size in players:
        rows = np.repeat(observe(2, size)[1:], 5_000, axis=0)
        action, log_prob = numpy_policy.act(rows, np.random.default_rng(0))
        assert action.dtype == log_prob.dtype == np.float32
        mean, std = policy(torch.tensor(rows))
        expected = gaussian.log_prob(torch.tensor(action), mean, std)
        np.testing.assert_allclose(log_prob, expected.detach(), atol=2e-4)
        noise = (action - mean.detach().numpy()) / std.detach().numpy()
        np.testing.assert_allclose(noise.mean(0), 0.0, atol=0.06)  # 4 standard errors
        np.testing.assert_allclose(noise.std(0), 1.0, atol=0.04)
        np.testing.assert_allclose(np.corrcoef(noise.T), np.eye(noise.shape[1]), atol=0.06)
        np.testing.assert_array_equal(action, numpy_policy.act(rows, np.random.default_rng(0))[0])
        assert np.abs(action).max() > 1.0  # not clipped


def test_evaluating_leaves_observations_and_parameters_alone(bob: MCPPolicy, observe: Observe) -> None:
    parameters = export_parameters(bob)
    numpy_policy = NumpyMCPPolicy(parameters)
    rows = observe(30, BOB.size)
    kept = rows.copy()
    before = np.stack(numpy_policy.distribution(rows))
    for value in parameters.values():
        value[...] = np.nan
    np.testing.assert_array_equal(np.stack(numpy_policy.distribution(rows)), before)
    np.testing.assert_array_equal(rows, kept)


def test_importing_and_using_it_needs_no_torch() -> None:
    script = (
        "import sys, service.policies.numpy_policy; "
        "heavy = {'torch', 'mujoco', 'pydantic', 'gymnasium'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)


Break = Callable[[dict[str, FloatArray]], None]


def _without(name: str) -> Break:
    return lambda parameters: parameters.__delitem__(name)


def _with(name: str, *shape: int, value: float = 0.5) -> Break:
    return lambda parameters: parameters.__setitem__(name, np.full(shape, value, dtype=np.float32))


BROKEN_BOB: list[tuple[Break, str]] = [
    (
        _without("primitives.trunk.0.weight"),
        r"\(KeyError: 'primitives\.trunk\.0\.weight'\); export them again",
    ),
    (_without("gate.weight_floor"), r"do not fit together \(KeyError: 'gate\.weight_floor'\)"),
    (_without("primitives.output_weight"), r"do not fit together \(KeyError: 'primitives\.output_weight'\)"),
    (_with("primitives.trunk.0.bias", 3), r"do not fit together \(ValueError: .*\(3,\)"),
    (_with("primitives.output_bias", 4, 6), "do not fit together"),
    (_with("primitives.hidden.weight", 500, 256), "do not fit together"),
    (_with("gate.output.weight", 3, 256), "do not fit together"),
    (_with("gate.input.offset", 14), "do not fit together"),
    (_with("gate.input.offset"), r"do not fit together \(TypeError: "),
    (_with("gate.output.bias", 4, value=np.nan), r"'gate\.output\.bias' of shape \(4,\) is not finite"),
    (_with("gate.hidden.2.weight", 256, 256), r"do not fit together \(KeyError: 'gate\.hidden\.2\.bias'\)"),
]


@pytest.mark.parametrize(("damage", "message"), BROKEN_BOB)
def test_broken_parameters_of_bob_are_refused(damage: Break, message: str) -> None:
    parameters = export_parameters(make_bob(PolicyConfig()))
    damage(parameters)
    with pytest.raises(PolicyError, match=message) as caught:
        NumpyMCPPolicy(parameters)
    assert "\n" not in str(caught.value)


def test_broken_parameters_of_alice_are_refused() -> None:
    parameters = export_parameters(make_alice(PolicyConfig()))
    odd = {**parameters, "output.weight": parameters["output.weight"][:7], "output.bias": parameters["output.bias"][:7]}
    with pytest.raises(PolicyError, match="policy parameters do not fit together"):
        NumpyGaussianPolicy(odd)
    integers: Parameters = {**parameters, "output.bias": np.zeros(8, dtype=np.int64)}
    with pytest.raises(PolicyError, match=r"'output\.bias' of shape \(8,\): expected float32, got int64"):
        NumpyGaussianPolicy(integers)


def test_one_players_parameters_do_not_make_the_other() -> None:
    config = PolicyConfig()
    with pytest.raises(PolicyError, match=r"KeyError: 'primitives\.input\.offset'"):
        NumpyMCPPolicy(export_parameters(make_alice(config)))
    with pytest.raises(PolicyError, match=r"KeyError: 'input\.offset'"):
        NumpyGaussianPolicy(export_parameters(make_bob(config)))


def test_inputs_of_a_wrong_size_are_refused() -> None:
    numpy_policy = NumpyMCPPolicy(export_parameters(make_bob(PolicyConfig())))
    with pytest.raises(PolicyError, match=r"observation: expected shape \(\.\.\., 14\), got \(5, 11\)"):
        numpy_policy.act_deterministic(np.zeros((5, 11), dtype=np.float32))
    with pytest.raises(PolicyError, match=r"positions: expected shape \(\.\.\., 11\), got \(14,\)"):
        numpy_policy.primitives(np.zeros(14, dtype=np.float32))
    with pytest.raises(PolicyError, match=r"weights: expected shape \(\.\.\., 4\), got \(5, 3\)"):
        numpy_policy.compose(np.zeros((5, 11), dtype=np.float32), np.ones((5, 3), dtype=np.float32))


@pytest.mark.parametrize(
    "weights",
    [
        [[1, 1, 1, 1], [0, 0, 0, 0]],
        [[1, 1, 1, 1], [1, 1, 1, -1]],
        [[1, 1, 1, np.nan]] * 2,
        [[np.inf] * 4] * 2,
        [[3e38] * 4] * 2,
        [[1e-45] * 4] * 2,
    ],
)
def test_weights_that_make_no_gaussian_are_refused(weights: list[list[float]]) -> None:
    numpy_policy = NumpyMCPPolicy(export_parameters(make_bob(PolicyConfig())))
    positions = np.zeros((2, 11), dtype=np.float32)
    with pytest.raises(PolicyError, match="weights: give numbers from 0 to 1e30, and in each row one above 1e-30"):
        numpy_policy.compose(positions, np.float32(weights))
    mean, std = numpy_policy.compose(positions, np.float32([[1, 0, 0, 0]] * 2))
    means, variances = numpy_policy.primitives(positions)
    np.testing.assert_allclose(mean, means[:, 0], rtol=1e-6)
    np.testing.assert_allclose(std, np.sqrt(variances[:, 0]), rtol=1e-6)


def test_a_file_of_parameters_runs_no_code(tmp_path: Path) -> None:
    np.savez(tmp_path / "network.npz", function=np.array([print], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle"):
        forward.load(tmp_path / "network.npz")
