"""Intervals of success, by hand."""

import pytest

from service.base.intervals import rate_of, seed_interval, wilson_interval


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


@pytest.mark.parametrize(
    ("successes", "low", "high"),
    [(25, 0.38, 0.66), (40, 0.70, 0.91), (45, 0.83, 0.98), (44, 0.80, 0.97), (47, 0.89, 1.0)],
)
def test_wilson_interval_of_48_episodes(successes, low, high):
    # algorithms.md 0.3
    assert tuple(round(end, 2) for end in wilson_interval(successes, 48)) == (low, high)


def test_wilson_interval_at_the_ends():
    # z^2 / (n + z^2) with n = 10: 3.8416 / 13.8416
    assert wilson_interval(0, 10) == pytest.approx((0.0, 3.8416 / 13.8416))
    assert wilson_interval(10, 10) == pytest.approx((10 / 13.8416, 1.0))
