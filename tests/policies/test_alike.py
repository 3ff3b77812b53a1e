"""Objects that are alike: networks see the nearest to the end effector first, whichever it is."""

import numpy as np
import pytest
import torch

from service.config.self_play import MCPConfig, MLPConfig, PolicyConfig
from service.envs.observations import Layouts, ObservationLayout
from service.policies.networks import ValueNetwork, export_parameters, make_alice, make_bob, nearest_first
from service.policies.numpy_policy import NumpyGaussianPolicy, NumpyMCPPolicy
from service.policies.parameters import PolicyError

SEEN = Layouts(num_objects=3, alike=(0, 2))
CONFIG = PolicyConfig(
    alice=MLPConfig(hidden_sizes=(8,)),
    bob=MCPConfig(num_primitives=2, trunk_hidden_sizes=(8,), primitive_hidden_size=4, gate_hidden_sizes=(8,)),
    value=MLPConfig(hidden_sizes=(8,)),
)


def rows(layout: ObservationLayout) -> np.ndarray:
    """Observations as they are measured: ways from the effector are differences of places."""
    found = np.random.default_rng(0).normal(0.0, 0.2, (20, layout.size)).astype(np.float32)
    effector = found[:, layout["effector"]]
    found[:, layout["object_from_effector"]] = found[:, layout["object"]] - np.tile(effector, 3)
    return found


def exchanged(found: np.ndarray, layout: ObservationLayout, one: int, other: int) -> np.ndarray:
    """The same with two objects exchanged, whatever is seen of them."""
    changed = found.copy()
    for entry in layout.entries:
        if entry.of_each_object:
            parts = changed[:, layout[entry.name]].reshape(len(found), 3, -1)
            parts[:, [one, other]] = parts[:, [other, one]]
            changed[:, layout[entry.name]] = parts.reshape(len(found), -1)
    return changed


def test_the_nearest_is_first_by_hand() -> None:
    by_object = torch.tensor([[1, 2, 3, 7], [4, 5, 6, 8]])
    values = torch.tensor(
        [[9.0, 3.0, 0.0, 0.0, 0.0, 2.0, 0.0, 10.0, 20.0], [9.0, 0.0, 1.0, 0.0, 0.0, 2.0, 0.0, 10.0, 20.0]]
    )
    assert nearest_first(values, by_object).tolist() == [
        [9.0, 0.0, 2.0, 0.0, 3.0, 0.0, 0.0, 20.0, 10.0],
        [9.0, 0.0, 1.0, 0.0, 0.0, 2.0, 0.0, 10.0, 20.0],
    ]


def test_who_acts_does_not_know_objects_that_are_alike_apart() -> None:
    torch.manual_seed(0)
    alice, bob = make_alice(CONFIG, SEEN), make_bob(CONFIG, SEEN)
    for parameter in [*alice.parameters(), *bob.parameters()]:
        torch.nn.init.normal_(parameter, 0.0, 0.5)
    for layout, network, acting in (
        (SEEN.full, alice, NumpyGaussianPolicy(export_parameters(alice))),
        (SEEN.bob, bob, NumpyMCPPolicy(export_parameters(bob))),
    ):
        found = rows(layout)
        alike, other = exchanged(found, layout, 0, 2), exchanged(found, layout, 0, 1)
        mean = acting.act_deterministic(found)
        np.testing.assert_allclose(acting.act_deterministic(alike), mean, atol=1e-6)
        assert np.abs(acting.act_deterministic(other) - mean).max() > 0.01
        with torch.no_grad():
            np.testing.assert_allclose(network(torch.from_numpy(found))[0], mean, atol=1e-5)
    positions = rows(SEEN.bob)[:, : SEEN.positions.size]
    weights = np.full((20, 2), 0.5, np.float32)
    np.testing.assert_allclose(
        acting.compose(exchanged(positions, SEEN.positions, 0, 2), weights)[0],
        acting.compose(positions, weights)[0],
        atol=1e-6,
    )
    value = ValueNetwork(SEEN.bob_value.normalisation, CONFIG.value)
    found = torch.from_numpy(rows(SEEN.bob_value))
    alike = torch.from_numpy(exchanged(found.numpy(), SEEN.bob_value, 0, 2))
    torch.testing.assert_close(value(alike), value(found))


def test_damaged_columns_are_one_line() -> None:
    parameters = export_parameters(make_alice(CONFIG, SEEN))
    parameters["input.by_object"][0, 0] = 99
    with pytest.raises(PolicyError, match=r"do not fit together \(IndexError: index 99 is out of bounds"):
        NumpyGaussianPolicy(parameters)
