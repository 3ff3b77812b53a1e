import pytest

from service.generator.penalty import OutsidePenalty


def test_threshold_zero_is_active_at_once():
    assert OutsidePenalty(0.0).active


def test_sets_in_once_the_smoothed_share_passes_and_stays():
    penalty = OutsidePenalty(0.3)
    # 0.5 * (1 - 0.9^8) = 0.2848, 0.5 * (1 - 0.9^9) = 0.3063
    for _ in range(8):
        penalty.record(0.5)
    assert not penalty.active
    penalty.record(0.5)
    assert penalty.active
    for _ in range(100):
        penalty.record(0.0)
    assert penalty.active


@pytest.mark.parametrize("num_before", [3, 9])
def test_state_continues(num_before):
    first, second = OutsidePenalty(0.3), OutsidePenalty(0.3)
    for _ in range(num_before):
        first.record(0.5)
    second.load_state(first.state())
    for _ in range(6):
        assert first.active == second.active
        first.record(0.5)
        second.record(0.5)
    assert first.active == second.active
