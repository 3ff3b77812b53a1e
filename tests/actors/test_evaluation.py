"""Bob on random goals: where the goals lie, what the rates mean, and what doing nothing scores."""

import json
import math

import numpy as np
import pytest

from service.actors.evaluation import Evaluation, IdlePolicy, evaluate, evaluated_goals
from service.base.intervals import wilson_interval
from service.base.liveness import work_done
from service.config import WorldConfig
from service.envs.sampling import GOAL_KINDS, sample_goals, sample_on_table

WORLD = WorldConfig()
FAST = WorldConfig(physics_step_s=0.004, num_substeps=10)
DISTANCE_M = 0.05
LOW, HIGH = (-0.225, -0.175), (0.125, 0.175)
"""Corners of the workspace's table area: 35 x 35 cm around (-0.05, 0)."""
REST_M = 0.025


class PickAndPlace:
    """Solves every goal, from positions alone: over the object, down, close, carry."""

    def act_deterministic(self, observation):
        ee, goal, from_ee = observation[:, 0:3], observation[:, 11:14], observation[:, 8:11]
        width = observation[:, 3:5].sum(axis=1)
        over = np.linalg.norm(from_ee[:, :2], axis=1) < 0.01
        held = (np.linalg.norm(from_ee, axis=1) < 0.025) & (width < 0.0515)
        around = held | (over & (from_ee[:, 2] > -0.006))
        action = np.zeros((len(observation), 4), dtype=np.float32)
        action[:, :2] = from_ee[:, :2] / DISTANCE_M
        action[:, 2] = np.where(over, from_ee[:, 2], 0.08 - ee[:, 2]) / DISTANCE_M
        action[:, 3] = np.where(around, -1.0, 1.0)
        carry = (goal - observation[:, 5:8]) / DISTANCE_M
        action[held, :3] = carry[held]
        return action


class Recorder(IdlePolicy):
    """Does nothing, and keeps what it was shown."""

    def __init__(self):
        self.seen = []

    def act_deterministic(self, observation):
        self.seen.append(observation.copy())
        return super().act_deterministic(observation)


def run(policy, kind="table", *, num_episodes=8, num_steps=2, seed=0, config=FAST, distance_m=DISTANCE_M):
    return evaluate(
        policy, config, kind, num_episodes=num_episodes, num_steps=num_steps, success_distance_m=distance_m,
        seed=seed, num_threads=1,
    )  # fmt: skip


def goals(kind, num=20_000, config=WORLD):
    return sample_goals(kind, np.random.default_rng(0), num, config, DISTANCE_M)


# --- goals -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", GOAL_KINDS)
def test_goals_lie_in_the_workspace_and_fill_it(kind):
    positions = goals(kind)
    assert positions.shape == (20_000, 3)
    assert ((positions[:, :2] >= LOW) & (positions[:, :2] <= HIGH)).all()
    np.testing.assert_allclose(positions[:, :2].min(axis=0), LOW, atol=1e-3)
    np.testing.assert_allclose(positions[:, :2].max(axis=0), HIGH, atol=1e-3)
    np.testing.assert_allclose(positions[:, :2].mean(axis=0), (-0.05, 0.0), atol=0.003)
    assert positions[:, 2].max() <= 0.35


def test_table_goals_lie_on_the_table():
    assert (goals("table")[:, 2] == REST_M).all()


def test_air_goals_are_out_of_reach_of_an_object_on_the_table():
    heights = goals("air")[:, 2]
    assert heights.min() >= REST_M + DISTANCE_M
    assert heights.min() < 0.076
    assert heights.max() > 0.349
    assert abs(heights.mean() - (0.075 + 0.35) / 2) < 0.003


def test_mixed_goals_are_on_the_table_in_three_of_ten():
    heights = goals("mixed")[:, 2]
    on_table = heights == REST_M
    assert abs(on_table.mean() - 0.3) < 0.013  # four standard deviations of 20,000 draws
    assert heights[~on_table].min() < 0.026  # the rest is anywhere in the volume, near the table, too
    assert abs(heights[~on_table].mean() - (REST_M + 0.35) / 2) < 0.003


def test_goals_follow_object_and_workspace():
    world = WorldConfig.model_validate({"object_size_m": 0.04, "workspace": {"center_x_m": 0.1, "length_y_m": 0.1}})
    positions = goals("table", config=world)
    assert (positions[:, 2] == 0.02).all()
    assert abs(positions[:, 0].mean() - 0.1) < 0.004
    assert np.abs(positions[:, 1]).max() <= 0.05


def idle_floor(kind, num=400_000):
    """Share of random goals that a random start solves already."""
    rng = np.random.default_rng(1)
    start = sample_on_table(rng, num, WORLD.workspace, WORLD.object_size_m)
    goal = sample_goals(kind, rng, num, WORLD, DISTANCE_M)
    return np.mean(np.linalg.norm(goal - start, axis=1) <= DISTANCE_M)


def test_the_idle_floor_is_the_analytic_one():
    # algorithms.md 7.4: 0.057 on 35 x 35 cm, 0.021 for the mixture. Two random points of a square of edge L are
    # within d of each other with probability pi r^2 - 8/3 r^3 + r^4 / 2, r = d / L.
    ratio = DISTANCE_M / 0.35
    exact = math.pi * ratio**2 - 8 / 3 * ratio**3 + ratio**4 / 2
    assert abs(exact - 0.057) < 5e-4
    assert abs(idle_floor("table") - exact) < 0.0015
    assert abs(idle_floor("mixed") - 0.021) < 0.001
    assert idle_floor("air", 10_000) == 0.0


# --- evaluate --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["table", "air"])
def test_a_perfect_policy_scores_one(kind):
    result = run(PickAndPlace(), kind, num_episodes=12, num_steps=40, config=WORLD)
    assert (result.success_last, result.success_ever) == (1.0, 1.0)
    assert result.mean_distance_m < 0.02
    assert result.success_last_low == pytest.approx(12 / (12 + 1.96**2))
    assert result.success_last_high == 1.0


def test_doing_nothing_scores_what_the_starts_give():
    recorder = Recorder()
    result = run(recorder, num_episodes=300)
    first = recorder.seen[0]
    distance = np.linalg.norm(first[:, 11:14] - first[:, 5:8], axis=1)
    share = np.mean(distance <= DISTANCE_M)
    assert 0.02 < share < 0.10
    assert result.success_last == result.success_ever == pytest.approx(share)
    assert result.mean_distance_m == pytest.approx(distance.mean(), abs=1e-3)
    assert (result.success_last_low, result.success_last_high) == wilson_interval(round(300 * share), 300)


def test_the_policy_sees_bobs_inputs_every_step():
    recorder = Recorder()
    run(recorder, num_episodes=5, num_steps=3)
    assert [rows.shape for rows in recorder.seen] == [(5, 14)] * 3
    assert {rows.dtype for rows in recorder.seen} == {np.dtype(np.float32)}
    first = recorder.seen[0]
    np.testing.assert_allclose(first[:, 8:11], first[:, 5:8] - first[:, 0:3], atol=1e-6)
    assert all(np.array_equal(rows[:, 11:], first[:, 11:]) for rows in recorder.seen)


class Sweep:
    """Shoves objects about: some pass a goal without staying there."""

    def act_deterministic(self, observation):
        action = np.zeros((len(observation), 4), dtype=np.float32)
        action[:, :2] = observation[:, 8:10] / DISTANCE_M
        action[:, 2] = (0.03 - observation[:, 2]) / DISTANCE_M
        action[:, 3] = -1.0
        return action


def test_ever_counts_what_was_left_again():
    result = run(Sweep(), num_episodes=64, num_steps=20, distance_m=0.12)
    assert result.success_last < result.success_ever < 1.0


def test_an_observer_is_given_the_worlds_at_the_start_and_after_every_step():
    steps = []
    common = {"num_episodes": 16, "num_steps": 12, "success_distance_m": 0.12, "seed": 0, "num_threads": 1}
    result = evaluate(
        Sweep(), FAST, "mixed", **common,
        observe=lambda worlds, goal, solved: steps.append(np.linalg.norm(worlds.object_position - goal, axis=1)),
    )  # fmt: skip
    assert result == evaluate(Sweep(), FAST, "mixed", **common)
    distance = np.stack(steps)
    assert distance.shape == (13, 16)
    assert result.mean_distance_m == distance[-1].mean() != distance[0].mean()
    assert result.success_last == (distance[-1] <= 0.12).mean()
    assert result.success_ever == (distance[1:].min(axis=0) <= 0.12).mean()


def test_a_seed_determines_goals_and_starts():
    one, same, other = (run(IdlePolicy(), num_episodes=20, seed=seed) for seed in (3, 3, 4))
    assert one == same
    assert one.mean_distance_m != other.mean_distance_m


def test_every_step_counts_as_work():
    """So a worker that evaluates is not taken for one that hangs, however long it takes."""
    before = work_done()
    run(IdlePolicy(), num_steps=7)
    assert work_done() - before == 7


def test_as_dict_is_json():
    result = run(IdlePolicy(), "mixed", num_episodes=3)
    tree = json.loads(json.dumps(result.as_dict()))
    assert Evaluation(**tree) == result
    assert (tree["goals"], tree["num_episodes"], tree["num_steps"]) == ("mixed", 3, 2)


def test_goals_that_a_world_cannot_have_are_not_asked_for():
    assert evaluated_goals(WorldConfig(), 0.05) == ("table", "air", "mixed")
    assert evaluated_goals(WorldConfig(fixture="wall"), 0.05) == ("table",)
    assert evaluated_goals(WorldConfig(workspace={"height_m": 0.06}), 0.05) == ("table", "mixed")
    assert evaluated_goals(WorldConfig(workspace={"height_m": 0.1}), 0.05) == ("table", "air", "mixed")
    assert evaluated_goals(WorldConfig(workspace={"height_m": 0.1}), 0.08) == ("table", "mixed")
    assert evaluated_goals(WorldConfig(objects=("cube", "cube")), 0.05) == ("table", "air", "mixed", "one")
