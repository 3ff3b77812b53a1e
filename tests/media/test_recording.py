"""Recorded rounds and episodes obey the rules of training and of evaluation: by the numbers of their states."""

from types import SimpleNamespace

import numpy as np
import pytest

from service.actors.coverage import skill_paths
from service.actors.evaluation import evaluate
from service.config import WorldConfig
from service.config.self_play import GameConfig, SelfPlayConfig
from service.config.skills import SkillsConfig
from service.envs.batch import WorldBatch
from service.generator.validity import Verdict
from service.media import recording, video
from service.media.dataset import played_turns
from service.media.recording import record_episodes, record_rounds, record_skills
from service.policies.frozen_skills import FrozenSkills
from tests.methods.skill_sets import parameters

PUSH = (-1.0, 0.0, -1.0, -1.0)
OPEN_AND_PUSH = (-1.0, 0.0, -1.0, 1.0)
NOTHING = (0.0, 0.0, 0.0, 0.0)
FINGERS, OBJECT = slice(8, 10), slice(10, 13)
"""Where they stand in a world's flat state: after time and seven joints."""
DISTANCE_M = 0.05


class Constant:
    """Alice or Bob: the same action always."""

    def __init__(self, action):
        self.action = np.asarray(action, dtype=np.float32)

    def act(self, observation, rng):
        return self.act_deterministic(observation), np.zeros(len(observation), dtype=np.float32)

    def act_deterministic(self, observation):
        return np.tile(self.action, (len(observation), 1))


def record(alice=PUSH, bob=PUSH, *, num_rounds=3, seed=0, **game):
    config = SelfPlayConfig(game=GameConfig(**{"alice_steps": 12, "bob_steps": 12} | game))
    return record_rounds(config, Constant(alice), Constant(bob), num_rounds=num_rounds, seed=seed)


def reached(played):
    """(T2 + 1,) the object is within the success distance."""
    return np.linalg.norm(played.bob_states[:, OBJECT] - played.goal, axis=1) <= DISTANCE_M


# --- rounds ----------------------------------------------------------------------------------------------------------


def test_recorded_rounds_are_rounds():
    rounds = record()
    assert len(rounds) == 3
    for played in rounds:
        assert played.verdict == Verdict.VALID
        assert played.alice_states.shape[0] == 13
        np.testing.assert_array_equal(played.alice_states[-1, OBJECT], played.goal)
        np.testing.assert_array_equal(played.bob_states[0], played.alice_states[0])
        # Bob does the same, so he comes by the same states, and stops as soon as he is near enough.
        np.testing.assert_array_equal(played.bob_states, played.alice_states[: len(played.bob_states)])
        assert played.solved
        assert reached(played).tolist() == [False] * (len(played.bob_states) - 1) + [True]
    moved = [np.linalg.norm(played.goal - played.alice_states[0, OBJECT]) for played in rounds]
    assert moved == sorted(moved, reverse=True)


def test_bob_plays_alices_goals_whatever_the_source_of_others():
    sources = {"goal_source": "uniform", "replay_invalid": True, "replay_fraction": 1.0}
    config = SelfPlayConfig(game={"alice_steps": 4, "bob_steps": 4}, generator=sources)
    for played in recording.play_rounds(config, Constant(NOTHING), Constant(NOTHING), num_rounds=4, seed=0):
        np.testing.assert_array_equal(played.alice_states[-1, OBJECT], played.goal)
        assert (played.verdict, len(played.bob_actions)) == (Verdict.NOT_MOVED, 0)


def test_rounds_without_alice_begin_with_bob():
    config = SelfPlayConfig(
        game={"alice_plays": False, "bob_steps": 4},
        generator={"goal_source": "uniform", "replay_invalid": True},
    )
    for played in recording.play_rounds(config, Constant(NOTHING), Constant(PUSH), num_rounds=4, seed=0):
        assert (len(played.alice_states), len(played.alice_actions)) == (1, 0)
        np.testing.assert_array_equal(played.alice_states[0], played.bob_states[0])
        assert played.bob_states[0, 0] == 0.0  # the time
        assert len(played.bob_states) == len(played.bob_actions) + 1 > 1
        assert [turn.is_alice for turn in played_turns([played])] == [False]


def test_the_actions_lead_from_state_to_state():
    for played in record(blocked_gripper_fraction=0.5):
        with WorldBatch(WorldConfig(), 1, num_threads=1, blocked_fraction=0.5) as worlds:
            for states, actions in (
                (played.alice_states, played.alice_actions),
                (played.bob_states, played.bob_actions),
            ):
                worlds.restore(states[:1])
                for action, after in zip(actions, states[1:], strict=True):
                    worlds.step(action[None])
                    np.testing.assert_array_equal(worlds.states[0], after)


class Sweep(Constant):
    """Moves forward close to the table, with closed fingers."""

    def __init__(self):
        super().__init__((1.0, 0.0, 0.0, -1.0))

    def act_deterministic(self, observation):
        action = super().act_deterministic(observation)
        action[:, 2] = np.clip((0.03 - observation[:, 2]) / 0.05, -1.0, 1.0)
        return action


@pytest.mark.parametrize("distance_m", [0.03, 0.06])
def test_the_caption_says_solved_where_the_runs_own_rule_does(monkeypatch, distance_m):
    config = SelfPlayConfig(
        game=GameConfig(alice_steps=5, bob_steps=11, bob_hold_steps=11, success_distance_m=distance_m)
    )
    rounds = record_rounds(config, Sweep(), Sweep(), num_rounds=30, seed=1)
    blank = SimpleNamespace(render=lambda state, goal=None: np.zeros((8, 8, 3), dtype=np.uint8))
    words, bar = [], video._bar
    monkeypatch.setattr(video, "_bar", lambda width, text, *more: words.append(text) or bar(width, text, *more))
    said, near = [], []
    for played in (played for played in rounds if played.verdict == Verdict.VALID):
        list(video._round_frames(blank, played, "", 1, 0.04, 0.04))
        said.append(words[-1])
        near.append(np.linalg.norm(played.bob_states[-1, OBJECT] - played.goal) <= distance_m)
    assert said == ["Bob: solved after 0.4 s" if solved else "Bob: not solved in 0.4 s" for solved in near]
    assert any(near)
    assert not all(near)


def test_the_length_of_alices_turn_is_drawn():
    rounds = [record(alice_steps_min=11, num_rounds=1, seed=seed)[0] for seed in range(4)]
    assert {len(played.alice_actions) for played in rounds} == {11, 12}
    for played in rounds:
        assert len(played.alice_states) == len(played.alice_actions) + 1
        np.testing.assert_array_equal(played.alice_states[-1, OBJECT], played.goal)
        np.testing.assert_array_equal(played.bob_states[0], played.alice_states[0])


def test_grippers_are_blocked_as_at_the_end_of_a_run():
    rounds = record(OPEN_AND_PUSH, num_rounds=64, blocked_gripper_fraction=0.5, blocked_gripper_min_success=0.9)
    blocked = [played.alice_states[0, -1] == 1.0 for played in rounds]
    assert 20 < sum(blocked) < 44  # four standard deviations of 64 draws are 16
    for played, is_blocked in zip(rounds, blocked, strict=True):
        # Open fingers are at 4 cm; a blow against the table moves blocked ones by millimetres.
        widest = played.alice_states[:, FINGERS].max()
        assert widest < 0.005 if is_blocked else widest > 0.039


def test_played_before_lifted_before_far():
    start = np.tile([0.0, 0.0, 0.025], (4, 1))
    goal = start + np.array([[0.30, 0, 0], [0.12, 0, 0.06], [0.20, 0, 0], [0.50, 0, 0.10]])
    records = SimpleNamespace(start_position=start, goal=goal, played=np.array([True, True, True, False]))
    interest = list(recording._interest(records, WorldConfig()))
    assert sorted(range(4), key=interest.__getitem__, reverse=True) == [1, 0, 2, 3]


# --- episodes --------------------------------------------------------------------------------------------------------


def test_recorded_episodes_are_those_of_the_evaluation():
    common = {"num_episodes": 40, "num_steps": 20, "success_distance_m": 0.12, "seed": 3}
    episodes = record_episodes(Constant(PUSH), WorldConfig(), "table", **common)
    result = evaluate(Constant(PUSH), WorldConfig(), "table", **common)
    assert 0.0 < result.success_last < result.success_ever
    assert result.success_last == episodes.reached[-1].mean()
    assert result.success_ever == episodes.reached[1:].any(axis=0).mean()
    distance = np.linalg.norm(episodes.states[-1][:, OBJECT] - episodes.goal, axis=1)
    assert result.mean_distance_m == pytest.approx(distance.mean(), abs=1e-12)
    few = episodes.first(3)
    np.testing.assert_array_equal(few.states, episodes.states[:, :3])
    np.testing.assert_array_equal(few.actions, episodes.actions[:, :3])
    np.testing.assert_array_equal(few.goal, episodes.goal[:3])


def test_recorded_skills_are_those_of_the_coverage():
    skills = FrozenSkills(parameters(), SkillsConfig(method="lsd"))
    common = {"num_skills": 3, "num_steps": 4, "seed": 5}
    episodes = record_skills(skills, WorldConfig(), **common)
    assert episodes.goal is None
    assert not episodes.reached.any()
    paths = skill_paths(skills, WorldConfig(), **common)
    np.testing.assert_array_equal(episodes.states[..., OBJECT].swapaxes(0, 1), paths)
