"""Adam on torch's fused kernel, whose state can be saved at any time, and tensors as arrays of a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor
from torch.optim.adam import adam

from service.base.tensors import join_parts
from service.base.types import Array, Arrays


class Adam:
    """Adam (Kingma and Ba 2015) on torch's fused kernel, through torch's functional form of it.

    ``torch.optim.Adam`` computes the same, but making one imports torch's compiler: seconds at every start, for
    nothing. The state exists from the start, so it has the same names at any time.
    """

    def __init__(self, parameters: Mapping[str, Tensor], learning_rate: float, *, epsilon: float) -> None:
        """Start with moments of zero; ``learning_rate`` may be changed between steps."""
        self.learning_rate, self._epsilon = learning_rate, epsilon
        self._parameters = parameters
        self._state = {
            "first_moment": {name: torch.zeros_like(each, requires_grad=False) for name, each in parameters.items()},
            "second_moment": {name: torch.zeros_like(each, requires_grad=False) for name, each in parameters.items()},
            "step": {name: torch.zeros((), device=each.device) for name, each in parameters.items()},
        }

    def descend(self, loss: Tensor) -> None:
        """Take a gradient step with these parameters alone: others, through which the loss goes, get no gradient."""
        parameters = list(self._parameters.values())
        for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            parameter.grad = gradient
        self.step()

    @torch.no_grad()
    def step(self) -> None:
        """Move the parameters that have a gradient; the others and their moments stay."""
        gradients = {name: each.grad for name, each in self._parameters.items() if each.grad is not None}
        first, second, steps = ([tensors[name] for name in gradients] for tensors in self._state.values())
        adam(
            [self._parameters[name] for name in gradients],
            list(gradients.values()),
            first,
            second,
            [],
            steps,
            fused=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self.learning_rate,
            weight_decay=0.0,
            eps=self._epsilon,
            maximize=False,
        )

    def tensors(self) -> dict[str, Tensor]:
        """Moments and step counts by name: the tensors themselves."""
        return join_parts(self._state)


def copied(tensors: Mapping[str, Tensor]) -> Arrays:
    """Tensors by name as arrays for a checkpoint."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in tensors.items()}


def put_back(state: Mapping[str, Array], tensors: Mapping[str, Tensor]) -> None:
    """Write what ``copied`` gave into the tensors."""
    with torch.no_grad():
        for name, tensor in tensors.items():
            tensor.copy_(torch.from_numpy(np.array(state[name])))
