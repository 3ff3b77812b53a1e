"""The pool of past players and the plan of a round."""

from __future__ import annotations

import numpy as np
import pytest

from service.generator.opponents import CURRENT, OpponentPool, Opponents


def pool_of(num: int, capacity: int = 5) -> OpponentPool:
    pool = OpponentPool(capacity)
    for version in range(num):
        pool.add({"w": np.array([version])}, {"w": np.array([-version])})
    return pool


def opponents(num: int) -> Opponents:
    return pool_of(num).freeze(0)


def test_full_pool_drops_the_oldest() -> None:
    pool = pool_of(7, capacity=3)
    assert len(pool) == 3
    assert [int(parameters["w"][0]) for parameters in pool.alice] == [4, 5, 6]
    assert [int(parameters["w"][0]) for parameters in pool.bob] == [-4, -5, -6]


def test_pool_copies_parameters() -> None:
    weights = np.ones(2)
    pool = OpponentPool(2)
    pool.add({"w": weights}, {"w": weights})
    weights[:] = 0.0
    assert pool.alice[0]["w"].tolist() == pool.bob[0]["w"].tolist() == [1.0, 1.0]


def test_no_past_opponents_while_the_pool_is_empty_or_the_fraction_zero() -> None:
    for pool, fraction in ((opponents(0), 0.2), (opponents(3), 0.0)):
        plan = pool.plan(10, fraction, np.random.default_rng(0))
        assert plan.alice_opponent.tolist() == plan.bob_opponent.tolist() == [CURRENT] * 10


@pytest.mark.parametrize(
    ("num_worlds", "fraction", "num_past"), [(160, 0.2, 32), (30, 0.1, 3), (10, 0.5, 5), (1, 0.5, 0), (5, 0.2, 1)]
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


def test_state_round_trip_keeps_order_and_slashes_in_names() -> None:
    pool = OpponentPool(12)
    for version in range(12):  # more than ten: "10" must not sort before "2"
        pool.add({"body/0.weight": np.full((2, 3), version, dtype=np.float32)}, {"gate": np.array([version])})
    copy = OpponentPool(12)
    copy.load_state(pool.state())
    assert [int(parameters["gate"][0]) for parameters in copy.bob] == list(range(12))
    assert copy.alice[11]["body/0.weight"].dtype == np.float32
    assert np.array_equal(copy.alice[11]["body/0.weight"], pool.alice[11]["body/0.weight"])


def test_frozen_opponents_stay_as_they_were() -> None:
    pool = pool_of(2, capacity=2)
    frozen = pool.freeze(7)
    pool.add({"w": np.array([9])}, {"w": np.array([-9])})
    assert frozen.version == 7
    assert [int(parameters["w"][0]) for parameters in frozen.alice] == [0, 1]
    assert [int(parameters["w"][0]) for parameters in frozen.bob] == [0, -1]


@pytest.mark.parametrize("num", [0, 3, 12])
def test_frozen_opponents_come_back_from_their_state(num: int) -> None:
    frozen = pool_of(num, capacity=12).freeze(7)
    back = Opponents.from_state(-1, frozen.state())
    assert back.version == -1
    assert [int(parameters["w"][0]) for parameters in back.alice] == list(range(num))
    assert [int(parameters["w"][0]) for parameters in back.bob] == [-version for version in range(num)]
