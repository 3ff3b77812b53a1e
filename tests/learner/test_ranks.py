"""Several processes learn what one does: from the same rows in the same minibatches, up to the order of float sums."""

import os
import re
import signal
from dataclasses import replace

import numpy as np
import pytest

from service.errors import GroupError
from service.learner.group import find_store
from service.learner.learner import Learner
from service.learner.player import LearnerError
from service.learner.shares import join_states
from tests.learner import ranks as work
from tests.learner.ranks import Ranks, learn_alone
from tests.learner.rollouts import make_config, make_demonstrations, make_rollout, nobody_learns

EVERYTHING = {
    "bob": {"mirror": "both"},
    "bob_window": 3,
    "bob_ema_decay": 0.5,
    "abc": {"num_iterations": 3, "mean_only": True},
    "self_imitation": {"weight": 0.5, "num_iterations": 2, "min_reward": 0.5},
}
NO_DEMONSTRATIONS = make_demonstrations(np.random.default_rng(0), 0)
REPLICATED = ("alice/", "bob/", "steady_bob/")


@pytest.fixture(scope="module")
def pair():
    ranks = Ranks(2)
    yield ranks
    ranks.close()


def play(config, num_updates=2, num_actors=3):
    """Rollouts for updates one after the other, each played with the version before."""
    learner, updates = Learner(config), []
    for sequence in range(num_updates):
        played = [
            replace(make_rollout(learner, sequence, seed=actor, num_demonstrations=4 + 3 * actor), actor=actor)
            for actor in range(num_actors)
        ]
        updates.append(played)
        for rollout in played:
            assert learner.ingest(rollout)
        learner.update()
    return updates


def assert_learned_alike(several, alone):
    """Metrics and joined states of several ranks and of one agree up to float sums."""
    (metrics, state), (expected_metrics, expected) = several, alone
    assert state.keys() == expected.keys()
    for name, array in expected.items():
        if array.dtype.kind == "f" and name.startswith(REPLICATED):
            np.testing.assert_allclose(state[name], array, rtol=1e-3, atol=2e-6, err_msg=name)
        else:
            assert state[name].dtype == array.dtype
            np.testing.assert_array_equal(state[name], array, err_msg=name)
    for each, wanted in zip(metrics, expected_metrics, strict=True):
        assert each == pytest.approx(wanted, rel=1e-3, abs=1e-5)


def joined(answers):
    """What the ranks answered, as one; their metrics are equal to the last bit."""
    errors = [each for each in answers if isinstance(each, Exception)]
    assert errors == []
    assert all(metrics == answers[0][0] for metrics, _ in answers)
    return answers[0][0], join_states([state for _, state in answers])


def test_a_group_adds_gathers_and_copies(pair):
    sums = pair.run(work.add_up, [1.0, 0.5, 4.0])
    for tensors in sums:
        assert [tensor.shape for tensor in tensors] == [(2, 1), (2, 2), (2, 3)]
        assert [tensor.sum() for tensor in tensors] == [3.0 * 1.0 * 2, 3.0 * 0.5 * 4, 3.0 * 4.0 * 6]
    for numbers, tensors in pair.run(work.gather_and_copy):
        assert numbers == [[], [10, 11]]
        assert tensors == [[0.0, 0.0, 0.0], 10.0]


@pytest.mark.parametrize(
    "settings",
    [
        {},
        EVERYTHING,
        {"bob": {"mirror": "random"}, "alice": {"mirror": "both"}},
        {
            "bob": {"target_kl": 1e-7, "mirror": "both"},
            "alice": {"mirror": "random"},
        },  # Bob stops in the middle of an epoch
        {"bob": {"target_kl": 1e-9, "learning_rate": 0.05}},  # Bob's update is undone
        {"bob": {"minibatch_size": 3}},  # some minibatches are one rank's alone
    ],
    ids=["plain", "everything", "reflected at random", "stopped", "undone", "tiny minibatches"],
)
def test_two_ranks_learn_what_one_does(pair, settings):
    config = make_config(**settings)
    updates = play(config)
    assert_learned_alike(joined(pair.run(work.learn, config, updates)), learn_alone(config, updates))


@pytest.mark.parametrize("cut", [0, 3])
def test_a_rank_without_rollouts_learns_along(pair, cut):
    config = make_config(**EVERYTHING)
    updates = play(config)
    several = joined(pair.run(work.learn, config, updates, None, cut))
    assert_learned_alike(several, learn_alone(config, updates))


def test_demonstrations_alone_and_nothing_at_all(pair):
    config = make_config(bob={"mirror": "both"})
    updates = [[replace(each, bob=nobody_learns(each.bob)) for each in played] for played in play(config)]
    alone = learn_alone(config, updates)
    assert_learned_alike(joined(pair.run(work.learn, config, updates)), alone)
    nothing = [
        [replace(each, alice=nobody_learns(each.alice), demonstrations=NO_DEMONSTRATIONS) for each in played]
        for played in updates
    ]
    several = joined(pair.run(work.learn, config, nothing))
    assert several[0][0]["learner/num_alice_samples"] == several[0][0]["learner/num_demonstrations"] == 0.0
    assert_learned_alike(several, learn_alone(config, nothing))


def test_what_is_not_finite_on_one_rank_stops_all(pair):
    config = make_config(alice={"num_epochs": 3}, bob={"num_epochs": 3})
    updates = play(config)
    for player in ("alice", "bob"):
        turns = getattr(updates[1][2], player)
        turns.observation[:, :, 0][turns.active] = np.nan
    alone = learn_alone(config, updates)
    assert alone[0][1]["learner/non_finite_steps"] >= 3.0
    assert alone[0][1]["learner/rollbacks"] >= 1.0
    assert_learned_alike(joined(pair.run(work.learn, config, updates)), alone)


def test_the_number_of_ranks_may_change(pair):
    """One, then two, then one again, through states as a checkpoint has them."""
    config = make_config(**EVERYTHING)
    updates = play(config, num_updates=3)
    _, state = learn_alone(config, updates[:1])
    first = joined(pair.run(work.learn, config, updates[1:2], state))
    assert_learned_alike(first, learn_alone(config, updates[1:2], state))
    second = learn_alone(config, updates[2:], first[1])
    assert_learned_alike(second, (second[0], learn_alone(config, updates)[1]))


def test_ranks_that_are_not_at_one_point_do_not_learn(pair):
    config = make_config()
    first, late = play(config, num_updates=2)
    late = [replace(each, policy_version=0) for each in late]  # the message tells the learner's version
    answers = pair.run(work.advance_random_numbers, config, [first, late])
    for error in answers:
        assert isinstance(error, LearnerError)
        numbers = "version 1 with random numbers and learning rates ([0-9a-f]{8}), rank 0 at 1 with ([0-9a-f]{8})"
        found = re.fullmatch(f"learner rank 1 is at {numbers}: start all ranks from one state", str(error))
        assert found
        assert found[1] != found[2]


def test_a_rank_that_hangs_is_an_error_of_the_other_and_a_new_group_works(pair):
    pair.meet(timeout_s=1.0)
    os.kill(pair.processes[1].pid, signal.SIGSTOP)
    try:
        pair.send(work.add_up, [1.0])
        (error,) = pair.answers(0)
    finally:
        os.kill(pair.processes[1].pid, signal.SIGCONT)
    assert isinstance(error, GroupError)
    assert "learner rank 0 of 2" in str(error)
    assert "did not answer within 1 s" in str(error)
    assert "\n" not in str(error)
    pair.answers(1)
    pair.meet()
    for (tensor,) in pair.run(work.add_up, [1.0]):
        np.testing.assert_array_equal(tensor, [[3.0], [3.0]])


def test_a_store_that_nobody_opened_is_one_line():
    with pytest.raises(GroupError, match=r"rank 0 does not answer at 127\.0\.0\.1:1 .*open all ports") as error:
        find_store("127.0.0.1", 1, timeout_s=0.5)
    assert "\n" not in str(error.value)
