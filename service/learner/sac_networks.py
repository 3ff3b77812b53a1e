"""Networks of soft actor-critic, in torch, for learning. Shapes: N rows, I inputs, A actions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from service.config.self_play import MCPConfig
from service.policies.forward import compose
from service.policies.numpy_actor import LOG_STD_MAX, LOG_STD_MIN, MCP_LOG_STD_MIN

_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


def make_layers(*sizes: int, layer_norm: bool = False) -> nn.Sequential:
    """Linear layers between every two neighbours of ``sizes``, with ReLU between them, initialised as torch does.

    With ``layer_norm`` hidden layers are normalised before the ReLU.
    """
    layers: list[nn.Module] = []
    *hidden, last = pairwise(sizes)
    for num_inputs, num_outputs in hidden:
        norm = [nn.LayerNorm(num_outputs)] if layer_norm else []
        layers += [nn.Linear(num_inputs, num_outputs), *norm, nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, nn.Linear(*last))


class GaussianActor(nn.Module):
    """Mean and log-std of the actions before the tanh."""

    def __init__(self, num_inputs: int, num_actions: int, hidden_sizes: Sequence[int]) -> None:
        super().__init__()
        self.layers = make_layers(num_inputs, *hidden_sizes, 2 * num_actions)

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-std, (N, A) each, at (N, I) inputs."""
        mean, log_std = self.layers(inputs).chunk(2, dim=-1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)


class Critics(nn.Module):
    """Two networks that each say what an action is worth, or F features of it."""

    def __init__(
        self,
        num_inputs: int,
        num_actions: int,
        hidden_sizes: Sequence[int],
        num_features: int | None = None,
        *,
        layer_norm: bool = False,
    ) -> None:
        super().__init__()
        sizes = (num_inputs + num_actions, *hidden_sizes, num_features or 1)
        self._has_features = num_features is not None
        self.first, self.second = (make_layers(*sizes, layer_norm=layer_norm) for _ in range(2))

    def forward(self, inputs: Tensor, actions: Tensor) -> Tensor:
        """(2, N) values of (N, A) actions at (N, I) inputs, or (2, N, F) features."""
        rows = torch.cat((inputs, actions), dim=1)
        first, second = self.first(rows), self.second(rows)
        return torch.stack((first, second)) if self._has_features else torch.cat((first, second), dim=1).T


def sample_actions(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Squashed actions ``tanh(mean + std * noise)`` (N, A) and their log-probabilities (N,).

    The Jacobian's logarithm, ``log(1 - tanh(u) ** 2)``, is ``2 (log 2 - u - softplus(-2 u))``: exact for large u, too.
    """
    before = mean + log_std.exp() * noise
    jacobian = 2.0 * (math.log(2.0) - before - functional.softplus(-2.0 * before))
    log_prob = -0.5 * noise.square() - log_std - _HALF_LOG_TWO_PI - jacobian
    return torch.tanh(before), log_prob.sum(dim=1)


class MCPActor(nn.Module):
    """A Multiplicative Compositional Policy as an actor, learned end to end (Peng et al. 2019).

    K primitives see the inputs that do not tell the goal, a gate sees all, and the product of the primitives'
    Gaussians raised to the gate's weights is the Gaussian before the tanh: squashing the composition, not each
    primitive, keeps the product a Gaussian.

    Args:
        num_without_goal: the first inputs, which primitives see.
        num_inputs: I.
        num_actions: A.
        config: number and sizes, as of a Bob; its bounds of the log-std are not used.
    """

    weight_floor: Tensor

    def __init__(self, num_without_goal: int, num_inputs: int, num_actions: int, config: MCPConfig) -> None:
        super().__init__()
        heads = config.num_primitives, config.primitive_hidden_size
        self.num_without_goal = num_without_goal
        self.register_buffer("weight_floor", torch.tensor(config.weight_floor))
        self.primitives = make_layers(num_without_goal, *config.trunk_hidden_sizes, math.prod(heads))
        self.gate = make_layers(num_inputs, *config.gate_hidden_sizes, config.num_primitives)
        bound = 1.0 / math.sqrt(config.primitive_hidden_size)
        self.output_weight = nn.Parameter(torch.empty(*heads, 2 * num_actions).uniform_(-bound, bound))
        self.output_bias = nn.Parameter(torch.empty(config.num_primitives, 2 * num_actions).uniform_(-bound, bound))

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-std, (N, A) each, at (N, I) inputs."""
        hidden = self.primitives(inputs[:, : self.num_without_goal]).relu()
        hidden = hidden.unflatten(1, self.output_weight.shape[:2])
        outputs = torch.einsum("nkh,kho->nko", hidden, self.output_weight) + self.output_bias
        means, log_stds = outputs.chunk(2, dim=-1)
        variances = (2.0 * log_stds.clamp(MCP_LOG_STD_MIN, LOG_STD_MAX)).exp()
        weights = self.weight_floor + (1.0 - self.weight_floor) * self.gate(inputs).sigmoid()
        mean, variance = compose(weights, means, variances)
        return mean, 0.5 * variance.log()
