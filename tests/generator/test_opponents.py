"""Past players and the plan of a round."""

from __future__ import annotations

import numpy as np
import pytest

from service.generator.opponents import CURRENT, Opponents


def opponents(num: int, capacity: int = 12) -> Opponents:
    pool = Opponents(0)
    for version in range(num):
        pool = pool.joined_by({"w": np.array([version])}, {"w": np.array([-version])}, version, capacity)
    return pool


def versions(pool: Opponents) -> list[tuple[int, int]]:
    """Parameters of each Alice and Bob."""
    return [(int(alice["w"][0]), int(bob["w"][0])) for alice, bob in zip(pool.alice, pool.bob, strict=True)]


def test_of_too_many_the_oldest_go_and_earlier_ones_stay_as_they_were() -> None:
    before, weights = opponents(3, capacity=3), np.full(2, 9)
    pool = before.joined_by({"w": weights}, {"w": weights}, 7, 3)
    weights[:] = 0  # what has joined is a copy
    assert (pool.version, versions(pool)) == (7, [(1, -1), (2, -2), (9, 9)])
    assert (before.version, versions(before)) == (2, [(0, 0), (1, -1), (2, -2)])


def test_no_past_opponents_while_the_pool_is_empty_or_the_fraction_zero() -> None:
    for pool, fraction in ((opponents(0), 0.2), (opponents(3), 0.0)):
        plan = pool.plan(10, fraction, np.random.default_rng(0))
        assert plan.alice_opponent.tolist() == plan.bob_opponent.tolist() == [CURRENT] * 10


@pytest.mark.parametrize(
    ("num_worlds", "fraction", "num_past"), [(160, 0.2, 32), (30, 0.1, 3), (10, 0.5, 5), (5, 0.2, 1)]
)
def test_shares_are_exact_and_disjoint(num_worlds: int, fraction: float, num_past: int) -> None:
    pool = opponents(5)
    for seed in range(5):
        plan = pool.plan(num_worlds, fraction, np.random.default_rng(seed))
        assert int(plan.alice_past.sum()) == int(plan.bob_past.sum()) == num_past
        assert not (plan.alice_past & plan.bob_past).any()


def test_a_broken_share_is_met_on_average() -> None:
    pool, rng = opponents(5), np.random.default_rng(1)
    drawn = [int(pool.plan(6, 0.2, rng).alice_past.sum()) for _ in range(2000)]
    assert set(drawn) == {1, 2}
    assert np.mean(drawn) == pytest.approx(1.2, abs=0.03)


def test_a_single_world_meets_them_as_often_as_each_of_many() -> None:
    pool, rng = opponents(5), np.random.default_rng(1)
    plans = [pool.plan(1, 0.2, rng) for _ in range(2000)]
    for past in ([plan.alice_past for plan in plans], [plan.bob_past for plan in plans]):
        assert np.mean(past) == pytest.approx(0.2, abs=0.03)
    assert not any((plan.alice_past & plan.bob_past).any() for plan in plans)


def test_every_snapshot_and_world_is_drawn() -> None:
    pool, rng = opponents(3), np.random.default_rng(2)
    plans = [pool.plan(10, 0.2, rng) for _ in range(100)]
    for opponent in (
        np.stack([plan.alice_opponent for plan in plans]),
        np.stack([plan.bob_opponent for plan in plans]),
    ):
        assert set(opponent.ravel()) == {CURRENT, 0, 1, 2}
        assert (opponent != CURRENT).any(axis=0).all()


def test_a_round_meets_one_snapshot_of_each_player() -> None:
    pool, rng = opponents(5), np.random.default_rng(4)
    plans = [pool.plan(40, 0.2, rng) for _ in range(40)]
    pairs = [(set(plan.alice_opponent) - {CURRENT}, set(plan.bob_opponent) - {CURRENT}) for plan in plans]
    assert all(len(alice) == len(bob) == 1 for alice, bob in pairs)
    assert any(alice != bob for alice, bob in pairs)  # drawn apart


def test_plan_is_deterministic_for_a_seed() -> None:
    pool = opponents(5)
    first, again, other = (pool.plan(40, 0.2, np.random.default_rng(seed)) for seed in (7, 7, 8))
    assert np.array_equal(first.alice_opponent, again.alice_opponent)
    assert np.array_equal(first.bob_opponent, again.bob_opponent)
    assert not np.array_equal(first.alice_opponent, other.alice_opponent)


@pytest.mark.parametrize("num", [0, 3, 12])  # of more than ten, "10" must not come before "2"
def test_they_come_back_from_their_state(num: int) -> None:
    back = Opponents.from_state(-1, opponents(num).state() | {"num": np.array(num)})
    assert (back.version, versions(back)) == (-1, [(version, -version) for version in range(num)])


def test_slashes_in_names_come_back() -> None:
    weight = np.ones((2, 3), dtype=np.float32)
    state = Opponents(0).joined_by({"body/0.weight": weight}, {}, 1, 5).state()
    assert list(state) == ["0/alice/body/0.weight"]
    assert state["0/alice/body/0.weight"].dtype == np.float32
