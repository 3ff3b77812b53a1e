"""The networks of both players, in torch, for learning.

Alice is a Gaussian policy. Bob is a Multiplicative Compositional Policy (Peng et al. 2019): K primitives that see
positions only, a gate that alone sees the goal, and the product of the primitives' Gaussians raised to its weights.
Shapes: (...) any batch axes, O observation size, K primitives, A action components.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import elu

from service.config import MCPConfig, MLPConfig, PolicyConfig
from service.envs.observations import ACTION, BOB, BOB_VALUE, FULL, GATE, POSITIONS, Normalisation
from service.policies.composition import compose
from service.policies.layers import GaussianSquash, HiddenLayers, InputNormalisation, linear, log_std_bias
from service.policies.parameters import PolicyError
from service.types import FloatArray

INITIAL_LOG_STD = -0.1
"""Log-std of a new policy's actions. The std is 0.9: chance has to find the object."""

_HIDDEN_GAIN = math.sqrt(2.0)
_SMALL_GAIN = 0.01
_PRIMITIVE_MEAN_GAIN = 0.3  # the primitives must differ from the start, or the gate has nothing to choose from
_GATE_GAIN = 1.0


class GaussianPolicy(nn.Module):
    """Alice, or a monolithic Bob: a diagonal Gaussian with bounded mean and bounded, state-dependent std."""

    def __init__(
        self,
        input_size: int,
        action_size: int,
        config: MLPConfig,
        log_std_min: float,
        log_std_max: float,
        normalisation: Normalisation,
    ) -> None:
        """Build with orthogonal weights; initially the mean is near 0 and the std ``exp(INITIAL_LOG_STD)``.

        Raises:
            PolicyError: the normalisation is not of ``input_size``, or the log-std bounds are not in order.
        """
        super().__init__()
        _check_log_std(log_std_min, log_std_max)
        self.input = _input(normalisation, input_size)
        self.hidden = HiddenLayers(input_size, config.hidden_sizes)
        self.output = linear(self.hidden.output_size, 2 * action_size, gain=_SMALL_GAIN)
        self.squash = GaussianSquash(log_std_min, log_std_max)
        nn.init.constant_(self.output.bias[action_size:], log_std_bias(INITIAL_LOG_STD, log_std_min, log_std_max))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std, (..., A) each, at (..., O) observations."""
        mean, log_std = self.squash(self.output(self.hidden(self.input(observation))))
        return mean, log_std.exp()


class Primitives(nn.Module):
    """K Gaussians over actions at (..., 11) positions: a shared trunk, one hidden layer of each primitive's own."""

    def __init__(self, config: MCPConfig, action_size: int) -> None:
        """Build; the initial std gives the composition ``exp(INITIAL_LOG_STD)`` under a new gate's weights."""
        super().__init__()
        self.num_primitives, self.action_size = config.num_primitives, action_size
        self.input = _input(POSITIONS.normalisation, POSITIONS.size)
        self.trunk = HiddenLayers(POSITIONS.size, config.trunk_hidden_sizes)
        self.hidden = nn.Linear(self.trunk.output_size, config.num_primitives * config.primitive_hidden_size)
        heads = config.num_primitives, config.primitive_hidden_size, 2 * action_size
        self.output_weight = nn.Parameter(torch.empty(heads))
        self.output_bias = nn.Parameter(torch.zeros(config.num_primitives, 2 * action_size))
        self.squash = GaussianSquash(config.log_std_min, config.log_std_max)
        self._initialise(config)

    def forward(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Means and variances, (..., K, A) each."""
        hidden = elu(self.hidden(self.trunk(self.input(positions))), inplace=True)
        heads = hidden.reshape(*hidden.shape[:-1], self.num_primitives, -1)
        output = torch.einsum("...kh,kho->...ko", heads, self.output_weight) + self.output_bias
        means, log_stds = self.squash(output)
        return means, (2.0 * log_stds).exp()

    @torch.no_grad()
    def _initialise(self, config: MCPConfig) -> None:
        nn.init.zeros_(self.hidden.bias)
        for hidden, output in zip(self.hidden.weight.chunk(self.num_primitives), self.output_weight, strict=True):
            nn.init.orthogonal_(hidden, _HIDDEN_GAIN)
            nn.init.orthogonal_(output[:, : self.action_size], _PRIMITIVE_MEAN_GAIN)
            nn.init.orthogonal_(output[:, self.action_size :], _SMALL_GAIN)
        weight = config.weight_floor + (1.0 - config.weight_floor) * 0.5
        log_std = INITIAL_LOG_STD + 0.5 * math.log(config.num_primitives * weight)
        self.output_bias[:, self.action_size :] = log_std_bias(log_std, config.log_std_min, config.log_std_max)


class Gate(nn.Module):
    """The primitives' weights (..., K) at (..., 14) observations, each in [floor, 1].

    Its network sees, besides the observation, the goal relative to the object.
    """

    weight_floor: Tensor

    def __init__(self, config: MCPConfig) -> None:
        """Build; initial weights scatter around one half."""
        super().__init__()
        self.input = InputNormalisation(GATE.normalisation)
        self.hidden = HiddenLayers(GATE.size, config.gate_hidden_sizes)
        self.output = linear(self.hidden.output_size, config.num_primitives, gain=_GATE_GAIN)
        self.register_buffer("weight_floor", torch.tensor(config.weight_floor))

    def forward(self, observation: Tensor) -> Tensor:
        """Weights; not normalised to sum to one, as in the paper."""
        goal_from_object = observation[..., BOB["goal"]] - observation[..., BOB["object"]]
        features = torch.cat((observation, goal_from_object), dim=-1)
        openness: Tensor = self.output(self.hidden(self.input(features))).sigmoid()
        return self.weight_floor + (1.0 - self.weight_floor) * openness


class MCPPolicy(nn.Module):
    """Bob: the composition of ``primitives`` under the weights of ``gate``.

    The goal reaches the gate only, so no primitive can solve everything by itself. With K = 1 the gate can therefore
    only widen or narrow a policy blind to the goal; the monolithic Bob of the ablation is a ``GaussianPolicy``.
    """

    def __init__(self, config: MCPConfig, action_size: int = ACTION.size) -> None:
        """Build both parts.

        Raises:
            PolicyError: the log-std bounds are not in order.
        """
        super().__init__()
        _check_log_std(config.log_std_min, config.log_std_max)
        self.primitives = Primitives(config, action_size)
        self.gate = Gate(config)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std, (..., A) each, of the composition at (..., 14) observations."""
        means, variances = self.primitives(observation[..., : POSITIONS.size])
        mean, variance = compose(self.gate(observation), means, variances)
        return mean, variance.sqrt()


class ValueNetwork(nn.Module):
    """The expected return at (..., V) value observations."""

    def __init__(self, input_size: int, config: MLPConfig, normalisation: Normalisation) -> None:
        """Build; initial values are near 0.

        Raises:
            PolicyError: the normalisation is not of ``input_size``.
        """
        super().__init__()
        self.input = _input(normalisation, input_size)
        self.hidden = HiddenLayers(input_size, config.hidden_sizes)
        self.output = linear(self.hidden.output_size, 1, gain=_SMALL_GAIN)

    def forward(self, observation: Tensor) -> Tensor:
        """Values (...,)."""
        value: Tensor = self.output(self.hidden(self.input(observation)))
        return value.squeeze(-1)


def make_alice(config: PolicyConfig) -> GaussianPolicy:
    """A new Alice; draws from torch's global generator.

    Raises:
        PolicyError: her log-std bounds are not in order.
    """
    bounds = config.alice_log_std_min, config.alice_log_std_max
    return GaussianPolicy(FULL.size, ACTION.size, config.alice, *bounds, FULL.normalisation)


def make_bob(config: PolicyConfig) -> MCPPolicy | GaussianPolicy:
    """A new Bob; draws from torch's global generator."""
    if config.monolithic_bob is None:
        return MCPPolicy(config.bob)
    bounds = config.bob.log_std_min, config.bob.log_std_max
    return GaussianPolicy(BOB.size, ACTION.size, config.monolithic_bob, *bounds, BOB.normalisation)


def make_alice_value(config: PolicyConfig) -> ValueNetwork:
    """A new value network for Alice; draws from torch's global generator."""
    return ValueNetwork(FULL.size, config.value, FULL.normalisation)


def make_bob_value(config: PolicyConfig) -> ValueNetwork:
    """A new value network for Bob; draws from torch's global generator."""
    return ValueNetwork(BOB_VALUE.size, config.value, BOB_VALUE.normalisation)


def export_parameters(module: nn.Module) -> dict[str, FloatArray]:
    """Parameters and buffers by their state-dict names, as float32 copies: all that a NumPy policy needs."""
    return {name: tensor.detach().cpu().numpy().astype(np.float32) for name, tensor in module.state_dict().items()}


def _input(normalisation: Normalisation, input_size: int) -> InputNormalisation:
    size = len(normalisation.offset)
    if size != input_size:
        raise PolicyError(f"normalisation of {size} inputs for a network of {input_size}; take the layout's own")
    return InputNormalisation(normalisation)


def _check_log_std(low: float, high: float) -> None:
    if not low < high:
        raise PolicyError(f"log_std_min {low} must be below log_std_max {high}; set both in the policy's configuration")
