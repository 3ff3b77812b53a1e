"""The game, played by scripts with a known outcome: verdicts, rewards and demonstrations are checked by hand."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from service.actors.self_play import SelfPlay, _contact_metrics
from service.base.liveness import work_done
from service.envs.batch import WorldBatch
from service.generator.opponents import RoundPlan
from service.generator.validity import Verdict
from tests.actors.players import (
    AT_REST,
    FALLS,
    IN_FRONT,
    LEAVES,
    OBJECT,
    SLIDES,
    Constant,
    Noise,
    Pusher,
    Start,
    alices_own,
    assert_same_rollout,
    assert_shapes,
    given,
    learned_from,
    make_config,
    make_game,
    place,
    play,
)

STARTS = [IN_FRONT, AT_REST, SLIDES, LEAVES, FALLS]
PUSHED, STILL, SLID, LEFT, FELL = range(5)
JOINT_VELOCITIES = slice(17, 24)


@pytest.fixture(scope="module")
def rollout():
    """Alice pushes, Bob idles: he fails where she did something, and solves where the object slides by itself."""
    return play(make_game(make_config(5), STARTS), Pusher(), version=3)


@pytest.fixture(autouse=True)
def somewhere_else(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs a diverged world to a file in the working directory


def idle_positions(start, num_steps):
    """(T, 3) path of an object that nobody touches."""
    with WorldBatch(make_config(1).world, 1, num_threads=1) as worlds:
        worlds.states[0, OBJECT], worlds.states[0, 26:29] = start.position, start.velocity
        path = np.empty((num_steps, 3))
        for step in range(num_steps):
            worlds.step(np.zeros((1, 4), dtype=np.float32))
            path[step] = worlds.object_position[0]
    return path


# --- verdicts and rewards --------------------------------------------------------------------------------------------


def test_verdicts(rollout):
    kinds = [Verdict.VALID, Verdict.NOT_MOVED, Verdict.VALID, Verdict.OUTSIDE, Verdict.FALLEN]
    assert rollout.records.verdict.tolist() == kinds
    assert rollout.records.played.tolist() == [kind == Verdict.VALID for kind in kinds]


def test_the_goal_is_where_the_object_is_at_the_end_of_alices_turn(rollout):
    path = idle_positions(SLIDES, 9)
    np.testing.assert_allclose(rollout.records.proposal[SLID], path[-1], atol=1e-5)
    assert 0.10 < rollout.records.proposal[SLID, 0] - SLIDES.position[0] < 0.13  # 1.5^2 / (2 g) = 0.115
    np.testing.assert_array_equal(rollout.records.goal, rollout.records.proposal)
    pushed = rollout.records.proposal[PUSHED] - np.array(IN_FRONT.position)
    assert pushed[0] > 0.05
    assert rollout.records.start_position.tolist() == [list(start.position) for start in STARTS]


def test_alice_is_paid_on_her_last_step_only(rollout):
    # valid 1, and 5 more where Bob fails; nothing where the goal is invalid
    assert rollout.alice.reward[-1].tolist() == [6.0, 0.0, 1.0, 0.0, 0.0]
    assert not rollout.alice.reward[:-1].any()
    assert rollout.alice.terminated[-1].all()
    assert not rollout.alice.terminated[:-1].any()
    assert rollout.alice.active.all()


def test_rewards_come_from_the_configuration():
    rewards = {"alice_valid_reward": 2.0, "alice_difficult_reward": 0.5}
    config = make_config(5, game=rewards | {"bob_success_reward": 7.0})
    rollout = play(make_game(config, STARTS), Pusher())
    assert rollout.alice.reward[-1].tolist() == [2.5, 0.0, 2.0, 0.0, 0.0]
    assert rollout.bob.reward.sum(axis=0).tolist() == [0.0, 0.0, 7.0, 0.0, 0.0]


def test_a_valid_goal_is_worth_more_where_goals_are_rare():
    rollout = play(make_game(make_config(5, game={"alice_novelty_reward": 2.0}), STARTS), Pusher())
    assert rollout.alice.reward[-1].tolist() == [6.5, 0.0, 1.5, 0.0, 0.0]  # novelty is 0.25


def test_bob_is_paid_once_and_his_turn_ends_there(rollout):
    path = idle_positions(SLIDES, 9)
    num_steps = 1 + int(np.argmax(np.linalg.norm(path - path[-1], axis=1) <= 0.05))
    assert 1 < num_steps < 7
    bob = rollout.bob
    assert rollout.records.solved.tolist() == [False, False, True, False, False]
    assert rollout.records.num_bob_steps.tolist() == [7, 0, num_steps, 0, 0]
    assert bob.active[:, SLID].tolist() == [step < num_steps for step in range(7)]
    assert bob.reward[:, SLID].tolist() == [float(step == num_steps - 1) for step in range(7)]
    assert bob.terminated[:, SLID].tolist() == [step == num_steps - 1 for step in range(7)]


class Mover(Constant):
    """Puts the object of every world somewhere before each step, and does nothing else."""

    def __init__(self, game, positions):
        super().__init__()
        self.game, self.positions = game, iter(positions)

    def act(self, observation, rng):
        place(self.game, [Start(next(self.positions))] * self.game.worlds.num_worlds)
        return super().act(observation, rng)


ON_GOAL, OFF_GOAL = (-0.15, 0.0, 0.025), (-0.15, 0.13, 0.025)


def play_moved(hold_steps, positions, *, version=0, **settings):
    """Bob's turn of a round in one world, whose goal is ``ON_GOAL`` and whose object is moved while Bob plays."""
    game = make_game(make_config(1, game={"bob_hold_steps": hold_steps, **settings}), [Start(OFF_GOAL)])
    choose = replay_in([0], game.worlds.states[0].copy(), ON_GOAL)
    return play(game, bob=Mover(game, positions), choose_goals=choose, version=version)


def test_bobs_reward_is_taken_back_when_the_object_leaves_the_goal():
    rollout = play_moved(3, [OFF_GOAL, ON_GOAL, ON_GOAL, OFF_GOAL, OFF_GOAL, ON_GOAL, OFF_GOAL])
    assert rollout.bob.reward[:, 0].tolist() == [0.0, 1.0, 0.0, -1.0, 0.0, 1.0, -1.0]
    assert not rollout.bob.terminated.any()
    assert not rollout.records.solved[0]
    assert rollout.records.num_bob_steps[0] == 7


@pytest.mark.parametrize(("hold_steps", "last"), [(1, 1), (2, 4), (3, 5)])
def test_bobs_turn_ends_once_the_object_was_on_the_goal_for_so_many_steps_in_a_row(hold_steps, last):
    rollout = play_moved(hold_steps, [OFF_GOAL, ON_GOAL, OFF_GOAL, ON_GOAL, ON_GOAL, ON_GOAL, ON_GOAL])
    assert rollout.bob.active[:, 0].tolist() == [step <= last for step in range(7)]
    assert rollout.bob.terminated[:, 0].tolist() == [step == last for step in range(7)]
    assert rollout.bob.reward[: last + 1, 0].tolist() == [0.0, 1.0, -1.0, 1.0, 0.0, 0.0][: last + 1]
    assert rollout.records.solved[0]
    assert rollout.records.num_bob_steps[0] == last + 1


def test_with_a_margin_bob_has_to_come_nearer():
    near = (-0.15, 0.045, 0.025)  # 4.5 cm from the goal
    positions = [OFF_GOAL, near, near, ON_GOAL, near, ON_GOAL, ON_GOAL]
    assert play_moved(3, positions).bob.reward[:, 0].tolist() == [0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    rollout = play_moved(3, positions, bob_margin_m=0.01)
    assert rollout.bob.reward[:, 0].tolist() == [0.0, 0.0, 0.0, 1.0, -1.0, 1.0, 0.0]
    assert rollout.records.solved[0]


def test_the_margin_counts_after_so_many_updates():
    positions = [OFF_GOAL, (-0.15, 0.045, 0.025), *[ON_GOAL] * 5]  # 4.5 cm from the goal at the second step
    paid = [
        play_moved(3, positions, version=version, bob_margin_m=0.01, bob_margin_after_updates=4).bob.reward[:, 0]
        for version in (3, 4)
    ]
    assert [int(reward.argmax()) for reward in paid] == [1, 2]


def test_a_goal_that_is_held_to_the_end_of_the_turn_is_solved_without_an_end():
    rollout = play_moved(3, [OFF_GOAL] * 5 + [ON_GOAL] * 2)
    assert rollout.records.solved[0]
    assert not rollout.bob.terminated.any()
    assert rollout.bob.reward[:, 0].tolist() == [0.0] * 5 + [1.0, 0.0]


def test_running_out_of_time_is_not_an_end(rollout):
    assert rollout.bob.active[:, PUSHED].all()
    assert not rollout.bob.terminated[:, PUSHED].any()
    assert not rollout.bob.reward[:, PUSHED].any()


def test_what_was_not_played_is_zero(rollout):
    bob = rollout.bob
    for name in ("observation", "value_observation", "action", "log_prob", "reward", "terminated"):
        assert not getattr(bob, name)[~bob.active].any(), name
    assert not bob.active[:, [STILL, LEFT, FELL]].any()


def test_who_is_learned_from(rollout):
    assert rollout.alice.learn.all()
    assert rollout.bob.learn.tolist() == [True, False, True, False, False]


# --- states ----------------------------------------------------------------------------------------------------------


def test_both_players_start_from_the_same_state():
    game = make_game(make_config(5), STARTS)
    before = game.worlds.states.copy()
    rollout = play(game, Pusher())
    assert np.array_equal(rollout.records.start_state, before)
    played = [PUSHED, SLID]
    assert np.array_equal(rollout.bob.observation[0, played, :11], rollout.alice.observation[0, played, :11])
    assert np.array_equal(rollout.bob.value_observation[0, played, :21], rollout.alice.observation[0, played, :21])
    assert np.array_equal(rollout.bob.observation[0, played, 11:], rollout.records.goal[played].astype(np.float32))


def test_observations_and_final_value_observations(rollout):
    """Simulate the recorded actions once more, with a batch of our own."""
    config, records = make_config(5), rollout.records
    with WorldBatch(config.world, 5, num_threads=1) as worlds:
        worlds.restore(records.start_state)
        for step in range(9):
            assert np.array_equal(rollout.alice.observation[step], worlds.full(step / 9))
            worlds.step(rollout.alice.action[step])
        assert np.array_equal(rollout.alice.final_value_observation, worlds.full(1.0))
        assert np.array_equal(records.proposal, worlds.object_position)
        worlds.restore(records.start_state)
        for step in range(7):
            playing = np.flatnonzero(rollout.bob.active[step])
            assert np.array_equal(rollout.bob.observation[step, playing, :11], worlds.positions()[playing])
            assert np.array_equal(rollout.bob.value_observation[step, playing], worlds.bob_value(records.goal)[playing])
            worlds.step(rollout.bob.action[step, playing], playing)
        assert np.array_equal(rollout.bob.final_value_observation, worlds.bob_value(records.goal))
    assert np.array_equal(rollout.alice.value_observation, rollout.alice.observation)


def test_an_observer_is_given_every_state_and_changes_nothing():
    config = make_config(5, game={"bob_hold_steps": 3, "alice_steps_min": 6})
    watched, alone = make_game(config, STARTS), make_game(config, STARTS)
    for _ in range(2):
        states = []
        rollout = play(watched, Pusher(), Noise(), observe=lambda now, states=states: states.append(now.copy()))
        assert_same_rollout(rollout, play(alone, Pusher(), Noise()))
        records, num_alice_steps = rollout.records, int(rollout.alice.active[:, 0].sum())
        assert len(states) == num_alice_steps + 1 + int(records.num_bob_steps.max()) + 1
        with WorldBatch(config.world, 5, num_threads=1) as worlds:
            worlds.restore(records.start_state)
            for action, state in zip(rollout.alice.action, states[:num_alice_steps], strict=False):
                assert np.array_equal(state, worlds.states)
                worlds.step(action)
            assert np.array_equal(states[num_alice_steps], worlds.states)
            worlds.restore(records.start_state)
            for step, state in enumerate(states[num_alice_steps + 1 :]):
                assert np.array_equal(state, worlds.states)
                if step < 7:
                    playing = np.flatnonzero(rollout.bob.active[step])
                    worlds.step(rollout.bob.action[step, playing], playing)
    assert np.array_equal(watched.worlds.states, alone.worlds.states)


def test_the_next_round_starts_where_alice_ended():
    game = make_game(make_config(2), [IN_FRONT, SLIDES])
    first = play(game, Pusher())
    with WorldBatch(make_config(2).world, 2, num_threads=1) as worlds:
        worlds.restore(first.records.start_state)
        for action in first.alice.action:
            worlds.step(action)
        assert np.array_equal(game.worlds.states, worlds.states)
    second = play(game, Pusher())
    assert np.array_equal(second.records.start_position, first.records.proposal)
    assert second.records.round_index.tolist() == [1, 1]


def assert_fresh(game, worlds):
    """Arm at home, gripper open, nothing moves, the object on the table inside the workspace."""
    states = game.worlds.states[worlds]
    assert not states[:, 17:].any()
    assert (states[:, 8:10] == 0.04).all()
    assert (states[:, 0] == 0.0).all()
    assert (states[:, 12] == 0.025).all()
    low, high = (-0.225, -0.175), (0.125, 0.175)
    assert ((states[:, 10:12] >= low) & (states[:, 10:12] <= high)).all()


def test_the_starts_of_a_round_are_copies_of_where_all_worlds_are():
    game = make_game(make_config(5, game={"num_goals": 2}), STARTS)
    for _ in range(2):
        starts = game.round_starts()
        records = play(game, Pusher()).records
        assert np.array_equal(starts["start_state"], records.start_state)
        assert np.array_equal(starts["start_position"], records.start_position)
    assert len(set(records.round_index)) == 2


def test_an_invalid_goal_ends_the_game():
    game = make_game(make_config(5), STARTS)
    play(game, Pusher())
    assert game.worlds.object_position[SLID, 0] > -0.03  # this one goes on
    assert_fresh(game, [STILL, LEFT, FELL])
    assert play(game).records.round_index.tolist() == [1, 0, 1, 0, 0]


def test_a_game_is_over_after_num_goals():
    game = make_game(make_config(2, game={"num_goals": 2}))
    indices = []
    for _ in range(3):
        place(game, [SLIDES, SLIDES])
        rollout = play(game)
        assert (rollout.records.verdict == Verdict.VALID).all()
        indices.append(rollout.records.round_index.tolist())
        if len(indices) == 2:
            assert_fresh(game, [0, 1])
    assert indices == [[0, 0], [1, 1], [0, 0]]


def test_a_blocked_gripper_is_blocked_for_the_whole_game_and_both_players():
    game = make_game(make_config(40, game={"num_goals": 3, "blocked_gripper_fraction": 0.5}))
    blocked = game.worlds.states[:, -1] == 1.0
    assert 10 < blocked.sum() < 30
    rollout = play(game, Constant((0.0, 0.0, 0.0, 1.0)), Constant((0.0, 0.0, 0.0, 1.0)))
    for turns in (rollout.alice, rollout.bob):
        seen = turns.observation[..., 3:5][turns.active & blocked]
        assert (np.abs(seen) < 2e-3).all()
    assert (rollout.records.start_state[:, -1] == blocked).all()
    restored = make_game(game.config, seed=1)
    restored.load_state(game.state())
    assert (restored.worlds.states[:, -1] == game.worlds.states[:, -1]).all()


# --- past opponents and replayed goals -------------------------------------------------------------------------------


def test_past_opponents_play_their_worlds_and_are_not_learned_from():
    plan = RoundPlan(alice_opponent=np.array([-1, 1, 0, -1, -1]), bob_opponent=np.array([-1, -1, -1, 0, 1]))
    game = make_game(make_config(5), [SLIDES] * 5)
    past_alice, past_bob = [Constant(mark=-1.0), Constant(mark=-2.0)], [Constant(mark=-5.0), Constant(mark=-6.0)]
    rollout = play(game, Constant(mark=-3.0), Constant(mark=-4.0), plan=plan, past_alice=past_alice, past_bob=past_bob)
    assert (rollout.alice.log_prob == [-3.0, -2.0, -1.0, -3.0, -3.0]).all()
    assert rollout.bob.log_prob[0].tolist() == [-4.0, -4.0, -4.0, -5.0, -6.0]
    assert rollout.alice.learn.tolist() == [True, False, False, True, True]
    assert rollout.bob.learn.tolist() == [True, True, True, False, False]
    assert rollout.records.alice_past.tolist() == [False, True, True, False, False]
    assert rollout.records.bob_past.tolist() == [False, False, False, True, True]


def test_each_policy_sees_its_own_worlds_rows_only():
    plan = RoundPlan(alice_opponent=np.array([0, -1, 0]), bob_opponent=np.array([-1, 0, -1]))
    alice, past_alice, bob, past_bob = (Constant() for _ in range(4))
    game = make_game(make_config(3), [SLIDES, IN_FRONT, AT_REST])
    rollout = play(game, alice, bob, plan=plan, past_alice=[past_alice], past_bob=[past_bob])
    assert np.array_equal(alice.seen[0], rollout.alice.observation[0, [1]])
    assert np.array_equal(past_alice.seen[0], rollout.alice.observation[0, [0, 2]])
    assert np.array_equal(bob.seen[0], rollout.bob.observation[0, [0]])
    assert past_bob.seen == []  # its world's goal was invalid


def replay_in(worlds, state, goal):
    """Alice's own goals, but in ``worlds`` a replayed one with its own start."""

    def choose(start_state, start_position, round_index, proposal, verdict):
        choice = alices_own(start_state, start_position, round_index, proposal, verdict)
        replayed, played = choice.replayed.copy(), choice.played.copy()
        replayed[worlds] = played[worlds] = True
        choice.goal[worlds], choice.start_state[worlds], choice.start_position[worlds] = goal, state, state[OBJECT]
        return replace(choice, replayed=replayed, from_reset=choice.from_reset & ~replayed, played=played)

    return choose


def test_a_replayed_goal_has_its_own_start_and_says_nothing_about_alice():
    game = make_game(make_config(4), [IN_FRONT, IN_FRONT, AT_REST, LEAVES])
    state = game.worlds.states[0].copy()
    state[OBJECT] = (-0.10, 0.05, 0.025)
    rollout = play(game, Pusher(), choose_goals=replay_in([1, 2], state, (0.0, -0.1, 0.025)))
    alice, bob, records = rollout.alice, rollout.bob, rollout.records
    np.testing.assert_allclose(bob.observation[0, [1, 2], 5:8], [(-0.10, 0.05, 0.025)] * 2, atol=1e-7)
    np.testing.assert_allclose(bob.observation[:, [1, 2], 11:], np.broadcast_to((0.0, -0.1, 0.025), (7, 2, 3)))
    assert bob.learn.tolist() == [True, True, True, False]
    # World 1: what her valid goal was worth is unknown. World 2: her goal was invalid, so its reward is known.
    assert alice.learn.tolist() == [True, False, True, True]
    assert alice.reward[-1].tolist() == [6.0, 1.0, 0.0, 0.0]
    assert rollout.demonstrations.action.shape == (9, 4)  # of world 0 alone
    # The game goes on where Alice's turn ended, not where Bob's replayed one did.
    np.testing.assert_array_equal(game.worlds.object_position[1], records.proposal[1])


# --- demonstrations --------------------------------------------------------------------------------------------------


def test_demonstrations_are_alices_turns_of_failed_goals_seen_by_bob():
    starts = [IN_FRONT, AT_REST, IN_FRONT, SLIDES, IN_FRONT]
    plan = RoundPlan(np.array([-1, -1, 0, -1, -1]), np.array([-1, -1, -1, -1, 0]))
    game = make_game(make_config(5), starts)
    rollout = play(game, Pusher(), plan=plan, past_alice=[Pusher()], past_bob=[Constant()])
    assert rollout.records.played.tolist() == [True, False, True, True, True]
    assert rollout.records.solved.tolist() == [False, False, False, True, False]
    # 0 and 2 were failed by the current Bob; 1 is invalid, 3 solved, 4 failed by a past Bob.
    rows = [(step, world) for step in range(9) for world in (0, 2)]
    demonstrations = rollout.demonstrations
    assert demonstrations.observation.shape == (18, 14)
    for row, (step, world) in enumerate(rows):
        assert np.array_equal(demonstrations.observation[row, :11], rollout.alice.observation[step, world, :11])
        assert np.array_equal(demonstrations.observation[row, 11:], rollout.records.goal[world].astype(np.float32))
        assert np.array_equal(demonstrations.action[row], rollout.alice.action[step, world])
    assert demonstrations.observation.dtype == demonstrations.action.dtype == np.float32


def test_with_hindsight_bobs_failures_show_the_way_to_where_the_object_came():
    starts = [IN_FRONT, AT_REST, LEAVES, SLIDES, IN_FRONT]
    plan = RoundPlan(np.full(5, -1), np.array([-1, -1, -1, -1, 0]))
    slid = idle_positions(SLIDES, 7)[-1]
    goals = np.array([(-0.1, -0.1, 0.025)] * 3 + [slid] + [(-0.1, -0.1, 0.025)])
    config = make_config(5, learner={"abc": {"hindsight": True}})
    chosen = given(goals, own=[0])
    rollout = play(make_game(config, starts), Pusher(), Pusher(), plan=plan, choose_goals=chosen, past_bob=[Pusher()])
    assert rollout.records.solved.tolist() == [False, False, False, True, False]
    # Bob moved 0 and 4 to a place inside, but 4 was a past Bob. He left 1 alone, and 2 slid out of the workspace.
    demonstrations, bob = rollout.demonstrations, rollout.bob
    assert demonstrations.observation.shape == (9 + 7, 14)
    assert np.array_equal(demonstrations.observation[:9, :11], rollout.alice.observation[:, 0, :11])
    assert np.array_equal(demonstrations.observation[:9, 11:], np.tile(goals[0].astype(np.float32), (9, 1)))
    achieved = bob.final_value_observation[0, 5:8]
    assert achieved[0] > IN_FRONT.position[0] + 0.05
    assert np.array_equal(demonstrations.observation[9:, :11], bob.observation[:, 0, :11])
    assert np.array_equal(demonstrations.observation[9:, 11:], np.tile(achieved, (7, 1)))
    assert np.array_equal(demonstrations.action[9:], bob.action[:, 0])
    without = play(make_game(make_config(5), starts), Pusher(), Pusher(), choose_goals=chosen)
    assert len(without.demonstrations.action) == 9


def test_of_bobs_failures_no_more_steps_are_shown_than_of_alices_turns():
    config = make_config(4, learner={"abc": {"hindsight": True}})
    chosen = given((-0.1, -0.1, 0.025), own=[0])
    rollout = play(make_game(config, [IN_FRONT] * 4), Pusher(), Pusher(), choose_goals=chosen)
    assert not rollout.records.solved.any()
    # 9 steps of Alice, and of Bob's 4 x 7 every fourth.
    actions = rollout.bob.action.swapaxes(0, 1).reshape(28, 4)
    rows = rollout.demonstrations.action[9:]
    assert len(rows) == 7
    assert all((row == actions).all(axis=1).any() for row in rows)


def test_no_failure_no_demonstrations():
    rollout = play(make_game(make_config(2), [AT_REST, SLIDES]))
    assert rollout.demonstrations.observation.shape == (0, 14)
    assert rollout.demonstrations.action.shape == (0, 4)


# --- bookkeeping -----------------------------------------------------------------------------------------------------


def test_shapes_and_types(rollout):
    assert_shapes(rollout.alice, 9, 5, 22, 22)
    assert_shapes(rollout.bob, 7, 5, 14, 27)
    for turns in (rollout.alice, rollout.bob):
        for name in ("observation", "value_observation", "final_value_observation", "action", "log_prob", "reward"):
            assert getattr(turns, name).dtype == np.float32, name
        assert turns.active.dtype == turns.terminated.dtype == turns.learn.dtype == np.bool_


def test_cells_that_an_object_reached_are_counted_whoever_plays():
    """By Alice on the first two worlds, by Bob on the first, whose goal is far; outside of the workspace: nowhere."""
    game = make_game(make_config(3), [IN_FRONT, AT_REST, LEAVES])
    assert not game.reached.any()
    rollout = play(game, Pusher(), choose_goals=given((-0.1, -0.1, 0.025)))
    by_both = game.reached.copy()
    assert by_both[game.cells.index(rollout.records.proposal[:1])] > 0
    assert by_both[game.cells.index(np.array([AT_REST.position]))] >= 9 + 7
    assert by_both.sum() < 3 * (9 + 7)  # LEAVES is outside for a while
    play(game, choose_goals=given((-0.1, -0.1, 0.025)))
    assert not np.array_equal(game.reached, by_both)  # of the last round only


def test_ids_increase_and_say_who_played():
    game = make_game(make_config(1), actor=4, incarnation=2)
    assert [play(game).id for _ in range(3)] == [(4, 2, 0), (4, 2, 1), (4, 2, 2)]


def test_env_steps_are_those_simulated(rollout):
    assert rollout.policy_version == 3
    bobs = int(rollout.records.num_bob_steps.sum())
    assert rollout.num_env_steps == 5 * 9 + bobs
    assert rollout.metrics["bob/env_steps_fraction"] == bobs / (5 * 9 + bobs)


def test_every_step_of_both_turns_counts_as_work():
    game, before = make_game(make_config(1), [IN_FRONT]), work_done()
    turns = play(game, Pusher())
    bobs = int(turns.bob.active.sum())
    assert bobs > 0
    assert work_done() - before == 9 + bobs


def test_contact_fractions():
    metrics = play(make_game(make_config(4), [IN_FRONT, AT_REST, SLIDES, AT_REST]), Pusher()).metrics
    assert metrics["alice/contact_fraction"] == 0.25


@pytest.mark.parametrize(
    ("touched", "contact", "both"),
    [
        ([[1, 0], [1, 1], [0, 0], [0, 1]], 0.75, 0.25),
        ([[1, 0, 0, 1], [0, 0, 1, 1]], 1.0, 0.5),  # two objects: no one object by both fingers in the first
    ],
)
def test_contact_fractions_by_hand(touched, contact, both):
    """Of (N, 2 K) left and right fingers on each object."""
    found = _contact_metrics(np.array(touched, dtype=bool))
    assert found == {"alice/contact_fraction": contact, "alice/both_contact_fraction": both}


# --- without Alice ---------------------------------------------------------------------------------------------------


def without_alice(num_worlds, **game):
    goals = {"goal_source": "uniform", "replay_invalid": True}
    return make_config(num_worlds, game={"alice_plays": False, **game}, generator=goals)


def test_without_alice_bob_goes_on_from_where_he_ended():
    game = make_game(without_alice(5, num_goals=3), STARTS)
    alice = Constant()
    first = play(game, alice, Pusher(), choose_goals=given((0.1, 0.1, 0.025)))
    assert alice.seen == []
    assert not first.alice.active.any()
    assert not first.alice.learn.any()
    assert not first.alice.reward.any()
    assert first.num_env_steps == 5 * 7
    assert first.metrics["bob/env_steps_fraction"] == 1.0
    assert (first.records.verdict == Verdict.NOT_MOVED).all()
    going_on = game._round_index > 0
    assert going_on.tolist() == [True, True, True, False, False]  # those that leave the workspace or fall begin anew
    end = game.worlds.object_position.copy()
    assert end[PUSHED, 0] > 0.05
    second = play(game, choose_goals=given((0.1, 0.1, 0.025)))
    np.testing.assert_array_equal(second.records.start_position[:3], end[:3])
    play(game, choose_goals=given((0.1, 0.1, 0.025)))
    assert (game._round_index[:3] == 0).all()


def test_without_alice_one_in_four_of_bobs_failing_steps_is_a_demonstration():
    config = without_alice(4)
    config = config.model_copy(update={"learner": make_config(1, learner={"abc": {"hindsight": True}}).learner})
    rollout = play(make_game(config, [IN_FRONT] * 4), bob=Pusher(), choose_goals=given((-0.1, -0.1, 0.025)))
    assert not rollout.records.solved.any()
    assert len(rollout.demonstrations.action) == 7  # of 4 x 7


# --- reproducible ----------------------------------------------------------------------------------------------------

BUSY = {"world": {"object_size_m": 0.07, "workspace": {"length_x_m": 0.15, "length_y_m": 0.15}}}
"""The object is right under the gripper, so that chance moves it."""


def busy_config():
    return make_config(8, game={"alice_steps": 5, "bob_steps": 4, "success_distance_m": 0.004, "num_goals": 2}, **BUSY)


def test_a_seed_determines_everything():
    games = [make_game(busy_config(), seed=seed) for seed in (1, 1, 2)]
    for _ in range(2):
        one, same, other = (play(game, Noise(), Noise()) for game in games)
        assert_same_rollout(one, same)
        assert not np.array_equal(one.alice.action, other.alice.action)
    assert 0 < one.records.played.sum() < 8


def test_a_restored_game_continues_bit_identically():
    game = make_game(busy_config(), seed=1)
    for _ in range(2):
        play(game, Noise(), Noise())
    state, rng_state = game.state(), game._rng.bit_generator.state
    state = {name: array.copy() for name, array in state.items()}
    restored = make_game(busy_config(), seed=9)
    restored.load_state(state)
    restored._rng.bit_generator.state = rng_state
    for _ in range(3):
        assert_same_rollout(play(game, Noise(), Noise()), play(restored, Noise(), Noise()))
    assert np.array_equal(game.worlds.states, restored.worlds.states)


def test_a_state_is_a_copy():
    game = make_game(busy_config(), seed=1)
    state = game.state()
    before = {name: array.copy() for name, array in state.items()}
    play(game, Noise(), Noise())
    assert all(np.array_equal(state[name], before[name]) for name in before)
    game.load_state(state)
    play(game, Noise(), Noise())
    assert all(np.array_equal(state[name], before[name]) for name in before)


# --- broken physics --------------------------------------------------------------------------------------------------


class Diverging:
    """A batch's physics, which in one call gives not-a-number in one row."""

    def __init__(self, pool, call, row):
        self._pool, self._left, self._row = pool, call, row

    def rollout(self, *args, **kwargs):
        states, sensors = self._pool.rollout(*args, **kwargs)
        if self._left == 0:
            states = states.copy()
            states[self._row, -1, 5] = np.nan
        self._left -= 1
        return states, sensors

    def close(self):
        self._pool.close()


def test_a_world_that_breaks_in_alices_turn_ends_as_fallen():
    game = make_game(make_config(3), [IN_FRONT, SLIDES, SLIDES])
    game.worlds._pool = Diverging(game.worlds._pool, call=4, row=1)
    rollout = play(game, Pusher())
    assert rollout.records.verdict.tolist() == [Verdict.VALID, Verdict.FALLEN, Verdict.VALID]
    assert rollout.alice.learn.tolist() == [True, False, True]
    assert rollout.alice.reward[-1].tolist() == [6.0, 0.0, 1.0]
    assert rollout.records.played.tolist() == [True, False, True]
    assert len(rollout.demonstrations.action) == 9
    assert_fresh(game, [1])
    assert len(rollout.diverged) == 1
    for turns in (rollout.alice, rollout.bob):
        assert np.isfinite(turns.observation).all()
        assert np.isfinite(turns.value_observation).all()


def test_a_world_that_breaks_in_bobs_turn_says_nothing_about_either_player():
    game = make_game(make_config(3), [IN_FRONT, IN_FRONT, SLIDES])
    game.worlds._pool = Diverging(game.worlds._pool, call=9 + 1, row=1)
    rollout = play(game, Pusher())
    assert rollout.records.verdict.tolist() == [Verdict.VALID] * 3
    assert not learned_from(rollout.alice, [1])
    assert not learned_from(rollout.bob, [1])
    assert rollout.bob.active[:, 1].sum() == 2
    assert rollout.records.solved.tolist() == [False, False, True]
    assert not rollout.records.played[1]  # or the difficulty statistics would count a failure
    assert len(rollout.demonstrations.action) == 9  # of world 0 alone
    assert rollout.alice.learn.tolist() == [True, False, True]


def test_without_alice_a_world_that_breaks_begins_anew(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    game = make_game(without_alice(2, num_goals=3), [IN_FRONT] * 2)
    game.worlds._pool = Diverging(game.worlds._pool, call=1, row=1)
    rollout = play(game, choose_goals=given((-0.1, -0.1, 0.025)))
    assert not rollout.bob.learn[1]
    assert game._round_index.tolist() == [1, 0]
    assert_fresh(game, [1])


def test_a_broken_world_is_reported_with_state_and_action_once():
    game = make_game(make_config(2), [SLIDES, AT_REST])
    before = game.worlds.states.copy()
    game.worlds._pool = Diverging(game.worlds._pool, call=0, row=1)
    rollout = play(game, Constant((0.5, 0.0, 0.0, -1.0)))
    ((state, action),) = rollout.diverged
    assert np.array_equal(state, before[1])
    assert action.tolist() == [0.5, 0.0, 0.0, -1.0]
    assert play(game).diverged == ()


def test_numbers_too_large_to_be_physics_are_broken_too():
    """MuJoCo's automatic reset is off: an arm that explodes stays finite for some steps, thousands of turns away."""
    game = make_game(make_config(2, game={"alice_steps": 1}), [AT_REST, AT_REST])
    states = game.worlds.states.copy()
    states[0, JOINT_VELOCITIES] = 1e4
    game.worlds.restore(states)
    rollout = play(game)
    assert rollout.records.verdict.tolist() == [Verdict.FALLEN, Verdict.NOT_MOVED]
    assert rollout.alice.learn.tolist() == [False, True]
    assert len(rollout.diverged) == 1


def test_a_turn_of_alice_may_be_shorter():
    config = make_config(5)
    config = config.model_copy(update={"game": config.game.model_copy(update={"alice_steps_min": 5})})
    lengths = set()
    for seed in range(12):
        rollout = play(make_game(config, STARTS, seed=seed), Pusher())
        active = rollout.alice.active
        length = int(active[:, 0].sum())
        lengths.add(length)
        assert active[:length].all()
        assert not active[length:].any()
        assert rollout.alice.terminated[length - 1].all()
        assert not rollout.alice.reward[: length - 1].any()
        assert rollout.alice.reward[length - 1, SLID] > 0.0
        assert not rollout.alice.reward[length:].any()
        # What she sees of time is what is left of it.
        np.testing.assert_allclose(rollout.alice.observation[:length, 0, -1], 1.0 - np.arange(length, 0, -1) / 9)
        path = idle_positions(SLIDES, length)
        np.testing.assert_allclose(rollout.records.proposal[SLID], path[-1], atol=1e-5)
    assert lengths == {5, 6, 7, 8, 9}


def test_grippers_are_blocked_once_bob_is_good_enough():
    config = make_config(40, game={"blocked_gripper_fraction": 0.5, "blocked_gripper_min_success": 0.6})
    with contextlib.closing(SelfPlay(config, np.random.default_rng(0), num_threads=1)) as game:

        def num_blocked():
            game.start_over()
            return int((game.worlds.states[:, game.worlds.layout["gripper_blocked"]] > 0.0).sum())

        assert num_blocked() == 0
        game.block_grippers(0.59)
        assert num_blocked() == 0
        game.block_grippers(0.6)
        assert 10 < num_blocked() < 30
        game.block_grippers(0.5)
        assert num_blocked() == 0
