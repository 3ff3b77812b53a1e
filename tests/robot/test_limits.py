import numpy as np
import pytest

from service.robot.limits import Box, SetPointLimiter

BOX = Box(np.array([-0.2, -0.2, 0.012]), np.array([0.2, 0.2, 0.4]))


def targets(rng, num):
    """Corners, far outside, tiny ways and anything between, each held for a while."""
    kinds = [
        lambda: rng.choice([-1e3, 1e3], 3),
        lambda: np.where(rng.random(3) < 0.5, BOX.lower_m, BOX.upper_m),
        lambda: rng.uniform(-0.3, 0.5, 3),
        lambda: np.array([0.2, 0.2, 0.012]) + rng.normal(0.0, 1e-3, 3),
    ]
    while num > 0:
        target, held = kinds[rng.integers(len(kinds))](), rng.integers(1, 40)
        yield from [target] * held
        num -= held


def test_ten_thousand_adversarial_targets_never_leave_the_bounds():
    rng = np.random.default_rng(0)
    limiter = SetPointLimiter(BOX, 1.7, 13.0)
    limiter.start(np.array([0.0, 0.0, 0.1]))
    before, velocity, fastest, hardest = limiter.position_m, np.zeros(3), 0.0, 0.0
    for target in targets(rng, 10_000):
        gap_s = rng.choice([0.0, 1e-4, 0.004, 0.004, 0.004, 0.03])
        arrive_s = rng.choice([0.0, 0.004, 0.04])
        place = limiter.brake(gap_s) if rng.random() < 0.05 else limiter.move(target, arrive_s, gap_s)
        assert BOX.contains(place)
        if not gap_s:
            np.testing.assert_array_equal(place, before)
            continue
        now = (place - before) / gap_s
        fastest = max(fastest, np.linalg.norm(now))
        hardest = max(hardest, np.linalg.norm(now - velocity) / gap_s)
        before, velocity = place, now
    assert 1.69 < fastest <= 1.7 + 1e-9  # the bounds are reached, too
    assert 12.9 < hardest <= 13.0 * (1 + 1e-6)


def test_from_outside_it_comes_in_without_a_jump_and_stays_inside():
    limiter = SetPointLimiter(BOX, 1.7, 13.0)
    begin = np.array([-0.21, 0.0, 0.004])
    limiter.start(begin)
    way = np.array([begin, begin, *(limiter.move(np.array([-1.0, 0.1, -1.0]), 0.04, 0.004) for _ in range(100))])
    assert np.linalg.norm(np.diff(way, 2, axis=0), axis=1).max() <= 13.0 * 0.004**2 * (1 + 1e-6)
    assert BOX.contains(way[-1], margin_m=1e-6)
    limiter.move(np.array([0.0, 0.1, 0.1]), 0.04, 0.004)
    for _ in range(200):
        way = limiter.move(np.array([-1.0, -1.0, -1.0]), 0.04, 0.004)
    assert BOX.contains(way)


def test_a_way_within_the_bounds_takes_its_time_and_no_longer():
    limiter = SetPointLimiter(BOX, 100.0, 1e6)
    limiter.start(np.array([0.0, 0.0, 0.1]))
    places = [limiter.move(np.array([0.04, 0.0, 0.1]), 0.04 - 0.004 * tick, 0.004)[0] for tick in range(10)]
    np.testing.assert_allclose(places, np.arange(1, 11) * 0.004, atol=1e-6)


def test_it_comes_to_a_target_without_going_past_it():
    limiter = SetPointLimiter(BOX, 1.7, 13.0)
    limiter.start(np.array([-0.15, 0.0, 0.1]))
    way = [limiter.move(np.array([0.1, 0.0, 0.1]), 0.0, 0.004)[0] for _ in range(200)]
    assert max(way) < 0.1 + 2e-4
    assert way[-1] == pytest.approx(0.1, abs=1e-6)
    assert limiter.velocity_m_s == pytest.approx(0.0, abs=1e-6)


def test_braking_ends_at_rest_after_the_way_that_physics_says():
    limiter = SetPointLimiter(BOX, 1.0, 10.0)
    limiter.start(np.array([-0.2, 0.0, 0.1]))
    while np.linalg.norm(limiter.velocity_m_s) < 0.999:
        limiter.move(np.array([0.2, 0.0, 0.1]), 0.0, 1e-4)
    begin = limiter.position_m[0]
    while not limiter.is_still:
        limiter.brake(1e-4)
    assert limiter.position_m[0] - begin == pytest.approx(1.0 / 20.0, rel=0.01)  # v^2 / 2a
