"""The networks of both players, in torch, for learning.

Alice is a Gaussian policy. Bob is a Multiplicative Compositional Policy (Peng et al. 2019): K primitives that see
positions only, a gate that alone sees the goal, and the product of the primitives' Gaussians raised to its weights.
Shapes: (...) any batch axes, O observation size, K primitives, A action components.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from service.base.types import FloatArray
from service.config.self_play import MCPConfig, MLPConfig, PolicyConfig
from service.envs.observations import ACTION, PAPER, POSITIONS, Layouts, Normalisation, ObservationLayout
from service.policies.forward import INPUT_CLIP, MEAN_BOUND, compose

INITIAL_LOG_STD = -0.1
"""Log-std of a new policy's actions. The std is 0.9: chance has to find the object."""

_LOG2_E = 1.0 / math.log(2.0)
_HIDDEN_GAIN = math.sqrt(2.0)
_SMALL_GAIN = 0.01
_PRIMITIVE_MEAN_GAIN = 0.3  # the primitives must differ from the start, or the gate has nothing to choose from
_GATE_GAIN = 1.0


class _ELU(torch.autograd.Function):
    """ELU by powers of two, in half of the time that torch's own takes on a CPU, where it is a fifth of learning.

    For x < 0, ``exp(x) - 1 >= x``, and for x >= 0 the first term is 0: a maximum picks the branch.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        """Map (...) to (...)."""
        negative = values.clamp(max=0.0).mul_(_LOG2_E).exp2_().sub_(1.0)
        result = torch.maximum(values, negative, out=negative)
        ctx.save_for_backward(result)
        return result

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """Multiply by the slope, which the result tells: 1, or result + 1 below 0."""
        (result,) = ctx.saved_tensors
        slope: Tensor = result.clamp(max=0.0).add_(1.0)
        return gradient * slope


def elu(values: Tensor) -> Tensor:
    """ELU (Clevert et al. 2016) of (...) values, to within 1e-7 of torch's."""
    result: Tensor = _ELU.apply(values)  # type: ignore[no-untyped-call]
    return result


class InputNormalisation(nn.Module):
    """Fixed normalisation, clipped to +- ``INPUT_CLIP``; its constants travel with the parameters.

    Of objects that are alike the nearest comes first.
    """

    offset: Tensor
    scale: Tensor
    by_object: Tensor | None

    def __init__(self, normalisation: Normalisation) -> None:
        super().__init__()
        self.register_buffer("offset", torch.tensor(normalisation.offset))
        self.register_buffer("scale", torch.tensor(normalisation.scale))
        columns = normalisation.by_object
        self.register_buffer("by_object", None if columns is None else torch.tensor(columns))

    def forward(self, values: Tensor) -> Tensor:
        """Normalise (..., O)."""
        if self.by_object is not None:
            values = nearest_first(values, self.by_object)
        return ((values - self.offset) / self.scale).clamp(-INPUT_CLIP, INPUT_CLIP)


def nearest_first(values: Tensor, by_object: Tensor) -> Tensor:
    """Sort what (..., O) rows have of objects by their distance from the end effector; see ``Normalisation``."""
    objects = values[..., by_object]
    order = objects[..., :3].square().sum(-1).argsort(dim=-1, stable=True)
    in_order = objects.gather(-2, order[..., None].expand_as(objects))
    return values.index_copy(-1, by_object.flatten(), in_order.flatten(-2))


class HiddenLayer(nn.Linear):
    """A linear layer followed by ELU."""

    def forward(self, values: Tensor) -> Tensor:
        """Map (..., inputs) to (..., outputs)."""
        return elu(super().forward(values))


def hidden_layers(input_size: int, hidden_sizes: Sequence[int]) -> nn.Sequential:
    """Hidden layers one after the other; orthogonal with gain sqrt(2)."""
    sizes = [input_size, *hidden_sizes]
    return nn.Sequential(*(initialised(HiddenLayer(*pair), gain=_HIDDEN_GAIN) for pair in pairwise(sizes)))


class GaussianSquash(nn.Module):
    """Bounded outputs (..., 2A): ``MEAN_BOUND * tanh(x / MEAN_BOUND)`` for the mean, a sigmoid for the log-std."""

    log_std_min: Tensor
    log_std_max: Tensor

    def __init__(self, log_std_min: float, log_std_max: float) -> None:
        super().__init__()
        self.register_buffer("log_std_min", torch.tensor(log_std_min))
        self.register_buffer("log_std_max", torch.tensor(log_std_max))

    def forward(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-std, (..., A) each."""
        mean, log_std = output.chunk(2, dim=-1)
        bounded = self.log_std_min + (self.log_std_max - self.log_std_min) * log_std.sigmoid()
        return MEAN_BOUND * torch.tanh(mean / MEAN_BOUND), bounded


def initialised(layer: nn.Linear, *, gain: float) -> nn.Linear:
    """The layer with orthogonal weights and a bias of zero."""
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def log_std_bias(log_std: float, log_std_min: float, log_std_max: float) -> float:
    """The raw output that squashes to ``log_std``, or to the nearest value not saturated (2 % inside the bounds)."""
    share = (log_std - log_std_min) / (log_std_max - log_std_min)
    share = min(max(share, 0.02), 0.98)
    return math.log(share / (1.0 - share))


class GaussianPolicy(nn.Module):
    """Alice, or a monolithic Bob: a diagonal Gaussian with bounded mean and bounded, state-dependent std."""

    def __init__(self, normalisation: Normalisation, config: MLPConfig, log_std_min: float, log_std_max: float) -> None:
        """Build with orthogonal weights; initially the mean is near 0 and the std ``exp(INITIAL_LOG_STD)``."""
        super().__init__()
        self.input = InputNormalisation(normalisation)
        self.hidden = hidden_layers(len(normalisation.offset), config.hidden_sizes)
        self.output = initialised(nn.Linear(config.hidden_sizes[-1], 2 * ACTION.size), gain=_SMALL_GAIN)
        self.squash = GaussianSquash(log_std_min, log_std_max)
        nn.init.constant_(self.output.bias[ACTION.size :], log_std_bias(INITIAL_LOG_STD, log_std_min, log_std_max))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std, (..., A) each, at (..., O) observations."""
        mean, log_std = self.squash(self.output(self.hidden(self.input(observation))))
        return mean, log_std.exp()


class Primitives(nn.Module):
    """K Gaussians over actions at (..., P) positions: a shared trunk, one hidden layer of each primitive's own."""

    def __init__(self, config: MCPConfig, positions: ObservationLayout = POSITIONS) -> None:
        """Build; the initial std gives the composition ``exp(INITIAL_LOG_STD)`` under a new gate's weights."""
        super().__init__()
        self.input = InputNormalisation(positions.normalisation)
        self.trunk = hidden_layers(positions.size, config.trunk_hidden_sizes)
        self.hidden = HiddenLayer(config.trunk_hidden_sizes[-1], config.num_primitives * config.primitive_hidden_size)
        heads = config.num_primitives, config.primitive_hidden_size, 2 * ACTION.size
        self.output_weight = nn.Parameter(torch.empty(heads))
        self.output_bias = nn.Parameter(torch.zeros(config.num_primitives, 2 * ACTION.size))
        self.squash = GaussianSquash(config.log_std_min, config.log_std_max)
        self._initialise(config)

    def forward(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Means and variances, (..., K, A) each."""
        hidden = self.hidden(self.trunk(self.input(positions)))
        heads = hidden.unflatten(-1, self.output_weight.shape[:2])
        output = torch.einsum("...kh,kho->...ko", heads, self.output_weight) + self.output_bias
        means, log_stds = self.squash(output)
        return means, (2.0 * log_stds).exp()

    @torch.no_grad()
    def _initialise(self, config: MCPConfig) -> None:
        nn.init.zeros_(self.hidden.bias)
        for hidden, output in zip(self.hidden.weight.chunk(config.num_primitives), self.output_weight, strict=True):
            nn.init.orthogonal_(hidden, _HIDDEN_GAIN)
            nn.init.orthogonal_(output[:, : ACTION.size], _PRIMITIVE_MEAN_GAIN)
            nn.init.orthogonal_(output[:, ACTION.size :], _SMALL_GAIN)
        weight = config.weight_floor + (1.0 - config.weight_floor) * 0.5
        log_std = INITIAL_LOG_STD + 0.5 * math.log(config.num_primitives * weight)
        self.output_bias[:, ACTION.size :] = log_std_bias(log_std, config.log_std_min, config.log_std_max)


class Gate(nn.Module):
    """The primitives' weights (..., K) at (..., O) observations, each in [floor, 1].

    Its network sees, besides the observation, the goals relative to their objects.
    """

    weight_floor: Tensor

    def __init__(self, config: MCPConfig, layouts: Layouts = PAPER) -> None:
        """Build; initial weights scatter around one half."""
        super().__init__()
        self._goal, self._object = layouts.bob["goal"], layouts.bob["object"]
        self.input = InputNormalisation(layouts.gate.normalisation)
        self.hidden = hidden_layers(layouts.gate.size, config.gate_hidden_sizes)
        self.output = initialised(nn.Linear(config.gate_hidden_sizes[-1], config.num_primitives), gain=_GATE_GAIN)
        self.register_buffer("weight_floor", torch.tensor(config.weight_floor))

    def forward(self, observation: Tensor) -> Tensor:
        """Weights; not normalised to sum to one, as in the paper."""
        goal_from_object = observation[..., self._goal] - observation[..., self._object]
        features = torch.cat((observation, goal_from_object), dim=-1)
        openness: Tensor = self.output(self.hidden(self.input(features))).sigmoid()
        return self.weight_floor + (1.0 - self.weight_floor) * openness


class MCPPolicy(nn.Module):
    """Bob: the composition of ``primitives`` under the weights of ``gate``.

    The goal reaches the gate only, so no primitive can solve everything by itself. With K = 1 the gate can therefore
    only widen or narrow a policy blind to the goal; the monolithic Bob of the ablation is a ``GaussianPolicy``.
    """

    def __init__(self, config: MCPConfig, layouts: Layouts = PAPER) -> None:
        super().__init__()
        self.num_positions = layouts.positions.size
        self.primitives = Primitives(config, layouts.positions)
        self.gate = Gate(config, layouts)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std, (..., A) each, of the composition at (..., O) observations."""
        means, variances = self.primitives(observation[..., : self.num_positions])
        mean, variance = compose(self.gate(observation), means, variances)
        return mean, variance.sqrt()


class ValueNetwork(nn.Module):
    """The expected return at (..., V) value observations."""

    def __init__(self, normalisation: Normalisation, config: MLPConfig) -> None:
        """Build; initial values are near 0."""
        super().__init__()
        self.input = InputNormalisation(normalisation)
        self.hidden = hidden_layers(len(normalisation.offset), config.hidden_sizes)
        self.output = initialised(nn.Linear(config.hidden_sizes[-1], 1), gain=_SMALL_GAIN)

    def forward(self, observation: Tensor) -> Tensor:
        """Values (...,)."""
        value: Tensor = self.output(self.hidden(self.input(observation)))
        return value.squeeze(-1)


def make_alice(config: PolicyConfig, layouts: Layouts = PAPER) -> GaussianPolicy:
    """A new Alice; draws from torch's global generator."""
    return GaussianPolicy(layouts.full.normalisation, config.alice, config.alice_log_std_min, config.alice_log_std_max)


def make_bob(config: PolicyConfig, layouts: Layouts = PAPER) -> MCPPolicy | GaussianPolicy:
    """A new Bob; draws from torch's global generator."""
    if config.monolithic_bob is None:
        return MCPPolicy(config.bob, layouts)
    return GaussianPolicy(
        layouts.bob.normalisation, config.monolithic_bob, config.bob.log_std_min, config.bob.log_std_max
    )


def export_parameters(module: nn.Module) -> dict[str, FloatArray]:
    """Parameters and buffers by their state-dict names, as float32 copies: all that a NumPy policy needs."""
    return {name: tensor.detach().cpu().numpy().astype(np.float32) for name, tensor in module.state_dict().items()}
