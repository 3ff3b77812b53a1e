import math

import pytest
import torch
from torch import nn

from service.policies.adam import Adam

EPSILON = 1e-5


def test_three_steps_by_hand():
    # Kingma and Ba 2015, algorithm 1, for one number; the second parameter has no gradient in the second step.
    gradients, rates = [0.5, -2.0, 1.0], [0.1, 0.05, 0.01]
    first, second = nn.Parameter(torch.ones(1)), nn.Parameter(torch.ones(1))
    adam = Adam({"first": first, "second": second}, 0.0, epsilon=EPSILON)
    expected, m, v = 1.0, 0.0, 0.0
    for step, (gradient, rate) in enumerate(zip(gradients, rates, strict=True), start=1):
        first.grad = torch.tensor([gradient])
        second.grad = None if step == 2 else torch.tensor([gradient])
        before = second.item()
        adam.learning_rate = rate
        adam.step()
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
        expected -= rate * (m / (1 - 0.9**step)) / (math.sqrt(v / (1 - 0.999**step)) + EPSILON)
        assert first.item() == pytest.approx(expected, rel=1e-5)
        assert (second.item() == before) == (step == 2)
    tensors = adam.tensors()
    assert tensors["first_moment/first"].item() == pytest.approx(m, rel=1e-5)
    assert tensors["second_moment/first"].item() == pytest.approx(v, rel=1e-4)
    assert (tensors["step/first"], tensors["step/second"]) == (3, 2)
