"""The lag of rollouts, bounded by counting them."""

import pytest

from service.cluster.slots import RolloutSlots
from service.learner.weights import MAX_POLICY_LAG


def test_one_actor_is_one_update_ahead():
    slots = RolloutSlots()
    first = slots.begin(0)
    slots.finish(first)
    assert slots.may_begin(1)
    second = slots.begin(0)  # while the first is learned from
    assert not slots.may_begin(1)
    slots.finish(second)
    assert not slots.may_begin(1)  # played, and waits for a learner that is busy with the first
    slots.publish([first])
    assert slots.may_begin(1)


def test_a_lost_round_frees_its_slot():
    slots = RolloutSlots()
    tickets = [slots.begin(0), slots.begin(0)]
    slots.finish(tickets[0])
    for ticket in tickets:  # being played, and played
        slots.lose(ticket)
    assert slots.num_taken == 0
    slots.lose(tickets[0])  # given up twice, as when an actor hangs and then dies
    assert slots.num_taken == 0


def test_an_update_waits_for_a_round_that_would_get_too_old():
    slots = RolloutSlots()
    slow = slots.begin(3)
    assert slots.may_update(3)  # 4 comes out; the slow round can be learned from by 4 to make 5: 1 behind
    assert slots.may_update(4)  # 5 comes out: 2 behind
    assert not slots.may_update(5)
    slots.finish(slow)
    assert slots.may_update(5)


@pytest.mark.parametrize("num_actors", [1, 2, 5])
@pytest.mark.parametrize("slowness", [1, 7])
def test_no_order_of_events_lets_a_rollout_get_too_old(num_actors, slowness):
    """Actor 0 is ``slowness`` times slower than the others, an update takes as long as a round."""
    slots, version, learning, learned_at, lags = RolloutSlots(), 0, None, 0, []
    playing, done = {}, []
    for now in range(400):
        for actor, (ticket, began, until) in list(playing.items()):
            if now >= until:
                slots.finish(ticket)
                done.append((ticket, began))
                del playing[actor]
        if learning is not None and now >= learned_at:
            lags += [version - began for _, began in learning]
            version += 1
            slots.publish([ticket for ticket, _ in learning])
            learning = None
        if learning is None and len(done) >= num_actors and slots.may_update(version):
            learning, done, learned_at = done, [], now + 10
        for actor in range(num_actors):
            if actor not in playing and slots.may_begin(num_actors):
                playing[actor] = slots.begin(version), version, now + 10 * (slowness if actor == 0 else 1)
    assert version >= (5 if slowness > 1 else 30)
    assert max(lags) <= MAX_POLICY_LAG
    if slowness == 1:
        assert sum(lags) / len(lags) <= 1


def test_a_round_that_was_released_holds_nothing_back():
    slots = RolloutSlots()
    late = slots.begin(3)
    slots.release(late)
    assert slots.num_taken == 0
    assert slots.may_update(100)
    slots.finish(late)  # it comes after all
    assert slots.num_taken == 1
    slots.publish([late])
    assert slots.num_taken == 0
