"""Building blocks of the torch networks: input normalisation, ELU layers, squashed outputs, initialisation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import elu

from service.envs.observations import Normalisation
from service.policies.parameters import INPUT_CLIP, MEAN_BOUND


class InputNormalisation(nn.Module):
    """Fixed normalisation, clipped to +- ``INPUT_CLIP``; its constants travel with the parameters."""

    offset: Tensor
    scale: Tensor

    def __init__(self, normalisation: Normalisation) -> None:
        """Copy the constants into buffers."""
        super().__init__()
        self.register_buffer("offset", torch.tensor(normalisation.offset))
        self.register_buffer("scale", torch.tensor(normalisation.scale))

    def forward(self, values: Tensor) -> Tensor:
        """Normalise (..., O)."""
        return ((values - self.offset) / self.scale).clamp(-INPUT_CLIP, INPUT_CLIP)


class HiddenLayers(nn.ModuleList):
    """Linear layers, each followed by ELU; orthogonal with gain sqrt(2)."""

    def __init__(self, input_size: int, hidden_sizes: Sequence[int]) -> None:
        """Build one layer per hidden size; ``output_size`` is the last."""
        sizes = [input_size, *hidden_sizes]
        super().__init__(linear(*pair, gain=math.sqrt(2.0)) for pair in pairwise(sizes))
        self.output_size = sizes[-1]

    def forward(self, values: Tensor) -> Tensor:
        """Map (..., input_size) to (..., output_size)."""
        for layer in self:
            values = elu(layer(values), inplace=True)
        return values


class GaussianSquash(nn.Module):
    """Bounded outputs (..., 2A): ``MEAN_BOUND * tanh(x / MEAN_BOUND)`` for the mean, a sigmoid for the log-std."""

    log_std_min: Tensor
    log_std_max: Tensor

    def __init__(self, log_std_min: float, log_std_max: float) -> None:
        """Keep the bounds as buffers."""
        super().__init__()
        self.register_buffer("log_std_min", torch.tensor(log_std_min))
        self.register_buffer("log_std_max", torch.tensor(log_std_max))

    def forward(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-std, (..., A) each."""
        mean, log_std = output.chunk(2, dim=-1)
        bounded = self.log_std_min + (self.log_std_max - self.log_std_min) * log_std.sigmoid()
        return MEAN_BOUND * torch.tanh(mean / MEAN_BOUND), bounded


def linear(inputs: int, outputs: int, *, gain: float) -> nn.Linear:
    """A linear layer, orthogonal, with zero bias."""
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def log_std_bias(log_std: float, log_std_min: float, log_std_max: float) -> float:
    """The raw output that squashes to ``log_std``, or to the nearest value not saturated (2 % inside the bounds)."""
    share = (log_std - log_std_min) / (log_std_max - log_std_min)
    share = min(max(share, 0.02), 0.98)
    return math.log(share / (1.0 - share))
