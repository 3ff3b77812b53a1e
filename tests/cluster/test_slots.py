"""The lag of rollouts, bounded by counting them."""

import pytest

from service.actors.rollout import MAX_POLICY_LAG
from service.cluster.iteration import may_begin, may_update


def test_an_update_waits_for_a_round_that_would_get_too_old():
    assert may_update(3, [3])  # 4 comes out; the slow round can be learned from by 4 to make 5: 1 behind
    assert may_update(4, [3, 4])  # 5 comes out: 2 behind
    assert not may_update(5, [3, 5])
    assert may_update(5, [])


@pytest.mark.parametrize("num_actors", [1, 2, 5])
@pytest.mark.parametrize("slowness", [1, 7])
def test_no_order_of_events_lets_a_rollout_get_too_old(num_actors, slowness):
    """Actor 0 is ``slowness`` times slower than the others, an update takes as long as a round."""
    version, learning, learned_at, lags = 0, [], 0, []
    playing, done = {}, []  # versions, and when the round is over
    for now in range(400):
        for actor, (began, until) in list(playing.items()):
            if now >= until:
                done.append(began)
                del playing[actor]
        if learning and now >= learned_at:
            lags += [version - began for began in learning]
            version, learning = version + 1, []
        if not learning and len(done) >= num_actors and may_update(version, [began for began, _ in playing.values()]):
            learning, done, learned_at = done, [], now + 10
        for actor in range(num_actors):
            if actor not in playing and may_begin(len(playing) + len(done) + len(learning), num_actors):
                playing[actor] = version, now + 10 * (slowness if actor == 0 else 1)
    assert version >= (5 if slowness > 1 else 30)
    assert max(lags) <= MAX_POLICY_LAG
    if slowness == 1:
        assert sum(lags) / len(lags) <= 1
    if num_actors == 1:
        assert set(lags) == {0, 1}  # one round is played while another is learned from, never two
