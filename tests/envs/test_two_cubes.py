"""Tasks with two cubes, and where a task has its objects start."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from service.actors.evaluation import IdlePolicy, evaluate
from service.base.errors import ConfigError
from service.base.user_code import CodeError
from service.config import WorldConfig
from service.config.world import RandomisationConfig
from service.envs.batch import WorldBatch
from service.envs.gym.vector import TabletopVectorEnv
from service.envs.observations import each_object
from service.envs.rules import Rules
from service.envs.task import Task
from service.envs.tasks import find_task
from service.methods import task_check
from service.methods.task_check import check_task
from tests.envs.scripted_cubes import play

FAST = WorldConfig(physics_step_s=0.004, num_substeps=10)
CUBES = FAST.model_copy(update={"objects": ("cube", "cube")})
FILE = Path(__file__).parents[2] / "docs" / "examples" / "two_cubes.py"
NAMES = ("STACK", "UNSTACK", "SORT", "CLEAR")
TASKS = {name: find_task(f"{FILE}:{name}") for name in NAMES}


@pytest.mark.parametrize("name", NAMES)
def test_each_can_be_solved_and_is_not_solved_by_doing_nothing(name):
    assert play(TASKS[name], FAST, num_episodes=10).mean() >= 0.8
    assert play(TASKS[name], FAST, num_episodes=10, idle=True).mean() <= 0.2


@pytest.mark.parametrize("name", NAMES)
def test_each_can_be_learned_with_hindsight(name, monkeypatch):
    monkeypatch.setattr(task_check, "_NUM_WORLDS", 8)
    check_task(TASKS[name], FAST, relabels=True)


def started(task, num=50, seed=0):
    """Places of the objects at the start of episodes, and their goals."""
    with closing(TabletopVectorEnv(num, FAST, task=task)) as envs:
        observation, _ = envs.reset(seed=seed)
    return each_object(observation["achieved_goal"]), each_object(observation["desired_goal"])


def test_red_starts_on_blue_where_it_is_to_be_taken_from():
    place, goal = started(TASKS["UNSTACK"])
    np.testing.assert_allclose(place[:, 0] - place[:, 1], np.tile([0.0, 0.0, 0.05], (50, 1)), atol=1e-6)
    np.testing.assert_array_equal(goal[:, 1], place[:, 1])
    np.testing.assert_allclose(goal[:, 0, 2], 0.025, atol=1e-6)
    again, _ = started(TASKS["UNSTACK"])
    np.testing.assert_array_equal(place, again)
    other, _ = started(TASKS["UNSTACK"], seed=1)
    assert (place != other).any()


def test_starts_know_objects_of_one_size():
    sizes = FAST.model_copy(update={"randomisation": RandomisationConfig(object_size=(0.7, 1.3), num_models=4)})
    with pytest.raises(ConfigError, match="Unstack: its starts know objects of one size"):
        TabletopVectorEnv(2, sizes, task=TASKS["UNSTACK"])


def test_later_episodes_start_there_too():
    task = TASKS["UNSTACK"]
    with closing(TabletopVectorEnv(2, FAST, task=task)) as envs:
        envs.reset(seed=0)
        for _ in range(task.episode_steps):
            observation, _, _, ended, _ = envs.step(np.zeros((2, 4), dtype=np.float32))
    assert ended.all()
    place = each_object(observation["achieved_goal"])
    np.testing.assert_allclose(place[:, 0] - place[:, 1], np.tile([0.0, 0.0, 0.05], (2, 1)), atol=1e-6)


def test_an_evaluation_starts_where_the_task_says():
    seen = []
    evaluate(
        IdlePolicy(),
        TASKS["UNSTACK"].world_from(FAST),
        TASKS["UNSTACK"],
        num_episodes=3,
        num_steps=1,
        success_distance_m=0.05,
        seed=0,
        observe=lambda worlds, goal, solved: seen.append(each_object(worlds.object_position).copy()),
    )
    np.testing.assert_allclose(seen[0][:, 0] - seen[0][:, 1], np.tile([0.0, 0.0, 0.05], (3, 1)), atol=1e-6)


@pytest.mark.parametrize(
    "starts",
    [
        lambda s, rng: s.objects.place[:, [0, 0]],  # the second one inside the first
        lambda s, rng: np.stack(
            [np.add(s.gripper, [0.0, 0.04, 0.0]), s.objects[:, 1].place], axis=1
        ),  # inside a finger
        lambda s, rng: np.add(s.objects.place, [2.0, 0.0, 0.0]),  # out of reach
        lambda s, rng: s.objects.place * [1.0, 1.0, 0.0],  # half inside the table
        lambda s, rng: np.add(s.objects.place, [0.0, 0.0, -0.005]),
    ],
)
def test_objects_do_not_start_inside_anything_or_out_of_reach(starts, monkeypatch):
    monkeypatch.setattr("service.envs.rules._MAX_DRAWS", 20)
    with WorldBatch(CUBES, 3, num_threads=1) as worlds:
        rng = np.random.default_rng(0)
        worlds.reset(rng)
        with pytest.raises(CodeError, match="starts gave no place that is within reach and clear"):
            Rules(Task("Mine", starts=starts), worlds).place(rng)


def test_places_that_are_not_clear_are_drawn_again():
    def starts(s, rng):
        place = s.objects.place.copy()
        inside = rng.random(len(place)) < 0.5
        place[inside, 1] = place[inside, 0]
        return place

    with WorldBatch(CUBES, 40, num_threads=1) as worlds:
        rng = np.random.default_rng(0)
        worlds.reset(rng)
        before = worlds.object_position.copy()
        Rules(Task("Mine", starts=starts), worlds).place(rng)
        np.testing.assert_array_equal(worlds.object_position, before)
        Rules(Task("Mine"), worlds).place(rng)  # says nothing
        np.testing.assert_array_equal(worlds.object_position, before)


def test_goals_of_two_do_not_lie_inside_each_other():
    def goals(s, rng):
        return rng.uniform([-0.1, -0.1, 0.025], [0.0, 0.0, 0.2], s.objects.place.shape)

    with WorldBatch(CUBES, 300, num_threads=1) as worlds:
        rng = np.random.default_rng(0)
        worlds.reset(rng)
        drawn = each_object(Rules(Task("Mine", goals=goals), worlds).draw(rng))
    assert (np.abs(drawn[:, 0] - drawn[:, 1]).max(axis=1) > 0.047).all()
