"""Adam (Kingma and Ba 2015) on torch's fused kernel, through torch's functional form of it.

``torch.optim.Adam`` computes the same, but making one imports torch's compiler: seconds at every start, for nothing.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

EPSILON = 1e-5
_BETA1, _BETA2 = 0.9, 0.999


class Adam:
    """Optimiser of named parameters; its state exists from the start, so it has the same names at any time."""

    def __init__(self, parameters: Mapping[str, nn.Parameter], learning_rate: float) -> None:
        """Start with moments of zero; ``learning_rate`` may be changed between steps."""
        self.learning_rate = learning_rate
        self._parameters = dict(parameters)
        self._first = {name: torch.zeros_like(each, requires_grad=False) for name, each in parameters.items()}
        self._second = {name: torch.zeros_like(each, requires_grad=False) for name, each in parameters.items()}
        self._steps = {name: torch.zeros((), device=each.device) for name, each in parameters.items()}

    def zero_grad(self) -> None:
        """Drop all gradients."""
        for parameter in self._parameters.values():
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Move the parameters that have a gradient; the others and their moments stay."""
        gradients = {name: each.grad for name, each in self._parameters.items() if each.grad is not None}
        adam(
            [self._parameters[name] for name in gradients],
            list(gradients.values()),
            [self._first[name] for name in gradients],
            [self._second[name] for name in gradients],
            [],
            [self._steps[name] for name in gradients],
            fused=True,
            amsgrad=False,
            beta1=_BETA1,
            beta2=_BETA2,
            lr=self.learning_rate,
            weight_decay=0.0,
            eps=EPSILON,
            maximize=False,
        )

    def tensors(self) -> dict[str, Tensor]:
        """Moments and step counts by name: the tensors themselves."""
        parts = {"first_moment": self._first, "second_moment": self._second, "step": self._steps}
        return {f"{part}/{name}": tensor for part, tensors in parts.items() for name, tensor in tensors.items()}
