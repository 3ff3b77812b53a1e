"""Players with random parameters, in several configurations."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
import pytest
import torch
from torch import nn

from service.config.self_play import MCPConfig, MLPConfig, PolicyConfig
from service.policies.networks import GaussianPolicy, MCPPolicy, make_alice, make_bob
from service.policies.parameters import FloatArray

Module = TypeVar("Module", bound=nn.Module)

CONFIGS = {
    "default": PolicyConfig(),
    "three_primitives": PolicyConfig(
        alice=MLPConfig(hidden_sizes=(24,)),
        alice_log_std_min=-1.0,
        alice_log_std_max=1.0,
        bob=MCPConfig(
            num_primitives=3,
            trunk_hidden_sizes=(20, 12),
            primitive_hidden_size=9,
            gate_hidden_sizes=(16,),
            weight_floor=0.2,
            log_std_min=-4.0,
            log_std_max=-0.5,
        ),
    ),
    "one_primitive": PolicyConfig(
        alice=MLPConfig(hidden_sizes=(7, 11, 5)),
        bob=MCPConfig(num_primitives=1, trunk_hidden_sizes=(8,), primitive_hidden_size=1, gate_hidden_sizes=(6, 6, 6)),
    ),
    "eight_primitives": PolicyConfig(bob=MCPConfig(num_primitives=8, primitive_hidden_size=32)),
}


@pytest.fixture(params=list(CONFIGS.values()), ids=list(CONFIGS))
def config(request: pytest.FixtureRequest) -> PolicyConfig:
    """Each of ``CONFIGS`` in turn."""
    value: PolicyConfig = request.param
    return value


@pytest.fixture
def alice(config: PolicyConfig) -> GaussianPolicy:
    """Alice with every parameter moved away from its initial value."""
    return _scatter(make_alice(config))


@pytest.fixture
def bob(config: PolicyConfig) -> MCPPolicy:
    """Bob with every parameter moved away from its initial value."""
    return _scatter(make_bob(config))


@pytest.fixture
def observe() -> Callable[[int, int], FloatArray]:
    """Makes (rows, size) observations spread as widely as the workspace, every tenth far outside it."""

    def make(num_rows: int, size: int) -> FloatArray:
        rows = 0.3 * np.random.default_rng(num_rows + size).standard_normal((num_rows, size))
        rows[::10] *= 20.0
        return rows.astype(np.float32)

    return make


def _scatter(module: Module) -> Module:
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator), alpha=0.05)
    return module
