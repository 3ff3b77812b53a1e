import math

import pytest
import torch

from service.learner import ppo

LN2 = math.log(2.0)


def surrogate(log_ratios, advantages, clip=0.2, dual_clip=3.0):
    log_prob = torch.tensor(log_ratios, requires_grad=True)
    loss, clip_fraction = ppo.clipped_surrogate(
        log_prob, torch.zeros(len(log_ratios)), torch.tensor(advantages), clip, dual_clip
    )
    loss.backward()
    return loss.item(), clip_fraction.item(), log_prob.grad.tolist()


@pytest.mark.parametrize(
    ("log_ratio", "advantage", "loss", "gradient"),
    [
        (0.0, 2.0, -2.0, -2.0),
        (math.log(1.1), 2.0, -2.2, -2.2),
        (LN2, 2.0, -2.4, 0.0),  # too likely already: clipped at 1.2
        (-LN2, 2.0, -1.0, -1.0),  # too unlikely but good: not clipped
        (-LN2, -2.0, 1.6, 0.0),  # unlikely enough: clipped at 0.8
        (LN2, -2.0, 4.0, 4.0),  # likely and bad: not clipped
        (2 * LN2, -2.0, 6.0, 0.0),  # likelier than the dual clip of 3
    ],
)
def test_surrogate_of_one_action(log_ratio, advantage, loss, gradient):
    actual_loss, clip_fraction, gradients = surrogate([log_ratio], [advantage])
    assert actual_loss == pytest.approx(loss, rel=1e-5)
    assert gradients == pytest.approx([gradient], rel=1e-5)
    assert clip_fraction == float(abs(math.exp(log_ratio) - 1.0) > 0.2)


def test_surrogate_is_a_mean():
    loss, clip_fraction, _ = surrogate([0.0, LN2, 0.0, 0.0], [1.0, 1.0, -1.0, 3.0])
    assert loss == pytest.approx(-(1.0 + 1.2 - 1.0 + 3.0) / 4)
    assert clip_fraction == 0.25


@pytest.mark.parametrize("log_ratio", [1e4, -1e4, 150.0])
@pytest.mark.parametrize("advantage", [1.0, -1.0])
def test_extreme_log_ratios_stay_finite(log_ratio, advantage):
    loss, _, gradients = surrogate([log_ratio], [advantage])
    assert math.isfinite(loss)
    assert all(math.isfinite(gradient) for gradient in gradients)
    log_prob = torch.tensor([log_ratio], requires_grad=True)
    cloning = ppo.cloning_loss(log_prob, torch.zeros(1), 0.2)
    cloning.backward()
    assert torch.isfinite(cloning)
    assert torch.isfinite(log_prob.grad).all()


def test_cloning_clips_only_what_became_likelier():
    log_prob = torch.tensor([math.log(1.1), math.log(1.3), -LN2], requires_grad=True)
    loss = ppo.cloning_loss(log_prob, torch.zeros(3), clip=0.2)
    loss.backward()
    assert loss.item() == pytest.approx(-(1.1 + 1.2 + 0.5) / 3)
    assert log_prob.grad.tolist() == pytest.approx([-1.1 / 3, 0.0, -0.5 / 3])


def test_value_loss_is_half_the_mean_squared_error():
    assert ppo.value_loss(torch.tensor([1.0, 2.0]), torch.tensor([0.0, 4.0])).item() == pytest.approx(1.25)
