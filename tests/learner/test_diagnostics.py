import pytest
import torch

from service.config.self_play import MCPConfig
from service.learner.diagnostics import composition_metrics
from service.policies.networks import MCPPolicy


def test_composition_metrics_of_constant_primitives():
    # Variances 1/4 and 1 under weights 0.25 and 0.75: precisions 1 and 0.75, composite variance 1 / 1.75.
    torch.manual_seed(0)
    bob = MCPPolicy(
        MCPConfig(num_primitives=2, trunk_hidden_sizes=(4,), primitive_hidden_size=4, gate_hidden_sizes=(4,))
    )
    bob.gate.forward = lambda observation: torch.tensor([0.25, 0.75]).expand(len(observation), 2)
    variances = torch.tensor([0.25, 1.0])[:, None].expand(2, 4)
    bob.primitives.forward = lambda positions: (
        torch.zeros(len(positions), 2, 4),
        variances.expand(len(positions), 2, 4),
    )
    metrics = composition_metrics(bob, torch.zeros(5, 14))
    assert metrics == pytest.approx(
        {
            "bob_std": 1.75**-0.5,
            "primitive_weight_0": 0.25,
            "primitive_weight_1": 0.75,
            "primitive_share_0": 1.0 / 1.75,
            "primitive_share_1": 0.75 / 1.75,
        }
    )
