import pytest

from service.methods.task_evaluation import rate_of, seed_interval


def test_rates_by_hand():
    seeds = [{"evaluation": {"num_episodes": 100, "success_last": rate}} for rate in (0.84, 0.80, 0.82, 0.96)]
    assert str(rate_of(seeds[:3])) == "82.0 % [77, 87] (3)"  # 0.82 +- 4.303 * 0.02 / sqrt(3)
    # Wilson, 2991 of 3000: seeds that are equal by chance are not known exactly
    equal = [{"evaluation": {"success_last": 0.997, "num_episodes": 1000}}] * 3
    assert (rate_of(equal).low, rate_of(equal).high) == pytest.approx((0.9943, 0.9984), abs=1e-4)
    assert str(rate_of(seeds[3:])) == "96.0 % [90, 98]* (1)"  # 96 of 100, Wilson (z = 1.96) is 0.902 to 0.984


def test_intervals_by_hand():
    assert seed_interval([0.80, 0.82, 0.84]) == pytest.approx(
        (0.82 - 4.303 * 0.02 / 3**0.5, 0.82 + 4.303 * 0.02 / 3**0.5)
    )
    assert seed_interval([0.0, 0.5, 1.0]) == (0.0, 1.0)
    assert seed_interval([0.5, 0.5]) == (0.5, 0.5)
    # four: Student's t of three degrees of freedom is 3.182, the standard error 0.11547 / 2
    assert seed_interval([0.4, 0.6] * 2) == pytest.approx((0.5 - 3.182 * 0.057735, 0.5 + 3.182 * 0.057735), abs=1e-5)
    assert seed_interval([0.0, 1.0] * 8) == pytest.approx((0.5 - 2.131 * 0.516398 / 4, 0.5 + 2.131 * 0.516398 / 4))
    half = 1.96 * (36 / 35 / 4) ** 0.5 / 6  # near enough from 31 degrees of freedom on
    assert seed_interval([0.0, 1.0] * 18) == pytest.approx((0.5 - half, 0.5 + half))
