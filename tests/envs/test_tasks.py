"""The six downstream tasks: where things are, what a wall and a box do, and that every one can be solved."""

import warnings
from contextlib import closing
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.env_checker import check_env as check_stable_baselines

import service.envs.gym.registration  # noqa: F401 - names the environments
from service.base.errors import TandemError
from service.config import WorldConfig
from service.envs import scene
from service.envs.batch import DISPLACEMENT_M, WorldBatch
from service.envs.gym.tabletop import TabletopEnv
from service.envs.gym.vector import TabletopVectorEnv
from service.envs.sampling import draw_goals
from service.envs.task import EPISODE_STEPS, Task
from service.envs.tasks import PAPERS, find_task
from service.envs.tasks import TASKS as NAMES
from tests.envs.scripted_tasks import play_task

CONFIG = WorldConfig(physics_step_s=0.005, num_substeps=8)
DOCS = Path(__file__).parents[2] / "docs"
RECORDED = DOCS / "results" / "scripted_tasks.json"
TASKS = {name: find_task(name) for name in PAPERS}
HARD_TASKS = {name: find_task(name) for name in NAMES if name not in PAPERS}
CENTER = np.array([-0.05, 0.0])
HALF = 0.175
"""Half of the workspace's length and width, metres."""


def draw(task, num, seed=0):
    """Starts, goals and places of the box of ``num`` episodes."""
    config = find_task(task).world_from(CONFIG)
    rng = np.random.default_rng(seed)
    with WorldBatch(config, num, num_threads=1) as worlds:
        worlds.reset(rng)
        places = worlds.places
        return places.object, draw_goals(find_task(task).goals, rng, config, 0.05, places), places.box


def drive(worlds, target, num_steps, grip=-1.0):
    """Servo every end effector towards ``target()`` (N, 3)."""
    actions = np.full((worlds.num_worlds, 4), grip, dtype=np.float32)
    for _ in range(num_steps):
        actions[:, :3] = np.clip((target() - worlds.ee_position) / DISPLACEMENT_M, -1.0, 1.0)
        worlds.step(actions)


class TestTable:
    def test_they_are_the_papers(self):
        assert [task.title for task in TASKS.values()] == ["Larger", "InAir", "Push", "Sphere", "Wall", "Box"]
        assert [task.goals for task in TASKS.values()] == ["mixed", "volume", "table", "mixed", "table", "table"]
        assert TASKS["inair"].id == "tandem/InAir-v1"

    def test_each_replaces_its_part_of_a_world_and_no_other(self):
        trained = WorldConfig(object_mass_kg=0.2, physics_step_s=0.005, num_substeps=8)
        worlds = {name: task.world_from(trained) for name, task in TASKS.items()}
        assert worlds["inair"] == trained
        assert worlds["push"] == trained.model_copy(update={"gripper": "blocked"})
        assert worlds["sphere"] == trained.model_copy(update={"object": "sphere"})
        assert worlds["wall"] == trained.model_copy(update={"fixture": "wall", "start_height_m": 0.12})
        assert worlds["box"] == trained.model_copy(update={"fixture": "box"})
        size = {"length_x_m": 0.45, "length_y_m": 0.45, "height_m": 0.4}
        assert worlds["larger"].workspace == trained.workspace.model_copy(update=size)

    def test_harder_ones_have_another_start_and_cube_and_the_same_goals(self):
        assert [task.id for task in HARD_TASKS.values()] == [
            f"tandem/Hard{title}-v1" for title in ("Larger", "InAir", "Push", "Box")
        ]
        harder = {"start_height_m": 0.2, "object_mass_kg": 1.0, "friction": 0.25, "pad_friction": 0.5}
        for name, task in HARD_TASKS.items():
            plain = TASKS[name.removeprefix("hard-")]
            assert task.goals == plain.goals
            assert task.world_from(CONFIG) == plain.world_from(CONFIG).model_copy(update=harder)
            assert find_task(name) is task

    def test_an_unknown_one_is_named_with_those_there_are(self):
        with pytest.raises(TandemError, match=r"unknown task 'moon'; choose one of larger, inair, push, .* box"):
            find_task("moon")
        with pytest.raises(TandemError, match="unknown task 'moon'"):
            TabletopEnv(CONFIG, task="moon")

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"config": WorldConfig(fixture="box"), "task": Task("Mine")}, "goals = 'mixed' with a box"),
            ({"config": WorldConfig(fixture="wall"), "task": Task("Mine", goals="air")}, "goals = 'air' with a wall"),
            ({"task": Task("Mine", goals="moon")}, "goals = 'moon'; choose one of table, air, mixed, volume"),
            ({"success_distance_m": float("nan")}, "success_distance_m = nan"),
        ],
    )
    @pytest.mark.parametrize("make", [TabletopEnv, TabletopVectorEnv])
    def test_what_does_not_go_together_is_refused(self, make, options, words):
        with pytest.raises(TandemError, match=words) as caught:
            make(**options)
        assert "\n" not in str(caught.value)


class TestDraws:
    @pytest.mark.parametrize(
        ("task", "in_volume", "half", "height"),
        [
            ("larger", 0.7, 0.225, 0.4),
            ("inair", 1.0, HALF, 0.35),
            ("push", 0.0, HALF, 0.025),
            ("sphere", 0.7, HALF, 0.35),
        ],
    )
    def test_goals_are_in_the_workspace_and_off_the_table_with_probability_p(self, task, in_volume, half, height):
        start, goal, box = draw(task, 2000)
        assert box.shape == (2000, 0)
        np.testing.assert_array_equal(start[:, 2], 0.025)
        for position in (start, goal):
            offset = np.abs(position[:, :2] - CENTER).max()
            assert 0.99 * half < offset <= half
        np.testing.assert_allclose((goal[:, 2] > 0.025).mean(), in_volume, rtol=0, atol=0.05)
        assert 0.97 * height < goal[:, 2].max() <= height

    def test_a_wall_is_between_object_and_goal(self):
        start, goal, _ = draw("wall", 2000)
        sides = np.sign(start[:, 0] - CENTER[0])
        np.testing.assert_array_equal(np.sign(goal[:, 0] - CENTER[0]), -sides)
        np.testing.assert_allclose((sides > 0).mean(), 0.5, rtol=0, atol=0.05)
        nearest = scene.WALL_THICKNESS_M / 2 + 0.025  # an object that touches the wall is not at a goal behind it
        assert np.abs(goal[:, 0] - CENTER[0]).min() + nearest > 0.05
        for position in (start, goal):
            np.testing.assert_array_equal(position[:, 2], 0.025)
            assert np.abs(position[:, 1]).max() <= HALF
            # half a wall of 1 cm, a gap of 5 mm, half a cube; then an area of 15 cm
            distance = np.abs(position[:, 0] - CENTER[0])
            assert 0.035 <= distance.min() < 0.036
            assert 0.184 < distance.max() <= 0.185

    def test_a_box_is_anywhere_and_the_object_beside_it_with_room_for_a_finger(self):
        start, goal, box = draw("box", 2000)
        np.testing.assert_allclose(goal - box, np.tile([0.0, 0.0, 0.025], (2000, 1)), rtol=0, atol=1e-12)
        offset = np.abs(box[:, :2] - CENTER)
        assert (offset.max(axis=0) > 0.99 * HALF).all()
        assert (offset <= HALF).all()
        apart = np.abs(start - box)[:, :2]
        # half a box, half a cube, and 5 mm along x or 4 cm along y, where a finger has to go between
        assert ((apart[:, 0] >= 0.08) | (apart[:, 1] >= 0.115)).all()
        assert np.abs(start[:, :2] - CENTER).max() <= HALF


class TestEnvironment:
    @pytest.fixture(params=["push", "box"])
    def made(self, request):
        env = gymnasium.make(TASKS[request.param].id, config=CONFIG)
        yield env
        env.close()

    def test_the_checkers_have_nothing_to_say(self, made):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_gymnasium(made.unwrapped, skip_render_check=True)
            check_stable_baselines(made.unwrapped)

    def test_many_at_once_play_the_same_episodes(self, made):
        """Bit for bit what gymnasium's own vector of single environments gives, through two ends of episodes."""
        single = {"autoreset_mode": AutoresetMode.SAME_STEP}
        few = gymnasium.make_vec(made.spec.id, 2, "sync", config=CONFIG, vector_kwargs=single)
        many = gymnasium.make_vec(made.spec.id, 2, config=CONFIG)
        assert isinstance(many, TabletopVectorEnv)
        assert many.max_episode_steps == EPISODE_STEPS
        with closing(TabletopVectorEnv(config=CONFIG)) as one:
            assert one.num_envs == 1
        assert data_equivalence(few.reset(seed=7), many.reset(seed=7), exact=True)
        rng = np.random.default_rng(1)
        for _ in range(2 * EPISODE_STEPS + 2):
            actions = rng.uniform(-1.0, 1.0, (2, 4)).astype(np.float32)
            assert data_equivalence(few.step(actions), many.step(actions), exact=True)
        few.close()
        many.close()


class TestVector:
    def test_worlds_that_diverge_end_alone(self):
        envs = TabletopVectorEnv(3, CONFIG)
        envs.reset(seed=0)
        envs._worlds.states[1, 29] = 1e200
        observation, _, terminated, truncated, info = envs.step(np.zeros((3, 4), dtype=np.float32))
        assert truncated.tolist() == info["_final_obs"].tolist() == [False, True, False]
        assert not terminated.any()
        assert info["final_info"]["diverged"].tolist() == [False, True, False]
        assert observation in envs.observation_space
        ends = [envs.step(np.zeros((3, 4), dtype=np.float32))[3] for _ in range(EPISODE_STEPS)]
        assert np.argmax(ends, axis=0).tolist() == [EPISODE_STEPS - 2, EPISODE_STEPS - 1, EPISODE_STEPS - 2]
        envs.close()

    def test_seeds_are_one_per_world(self):
        envs = TabletopVectorEnv(3, CONFIG)
        with pytest.raises(ValueError, match="expected 3"):
            envs.reset(seed=[1, 2])
        envs.close()


def assert_touched(distance):
    """A cube's centre came as near to a face as it can: half its edge, or half its diagonal if it turned."""
    assert (distance > 0.025 - 0.002).all()
    assert (distance < 0.025 * np.sqrt(2) + 0.001).all()


def test_success_in_a_box_is_inside():
    """A cube counts with its underside below the rim, 5 cm up, anywhere on the bottom, and nowhere beside."""
    env = TabletopEnv(CONFIG, task="box")
    goal = env.reset(seed=0)[0]["desired_goal"]
    offsets = [
        [0.0, 0.0, 0.0499],  # half a cube above 4.99 cm
        [0.02, -0.02, 0.005],  # in a corner of the bottom, which is 9 cm wide and 5 mm thick
        [0.0, 0.0, 0.0501],
        [0.02, -0.02, 0.05],  # on the rim
        [0.075, 0.0, 0.0],  # on the table, at the wall
    ]
    assert env.compute_reward(goal + np.array(offsets), goal, {}).tolist() == [1.0, 1.0, 0.0, 0.0, 0.0]
    env.close()


class TestFixtures:
    """Fixtures stop what they must, and only that."""

    SIDES = np.array([-1.0, 1.0])

    def pushed(self, task, place):
        """Distance from an object's centre to the middle of ``place`` along x, pushed from either side.

        Returns:
            The least, (2,), where the arm strikes at full speed, and that at the end, (2,), where it leans on.
        """
        config = TASKS[task].world_from(CONFIG)
        with WorldBatch(config, 2, num_threads=1) as worlds:
            worlds.reset(np.random.default_rng(0))
            worlds.object_position[:] = place + np.outer(self.SIDES, [0.12, 0.0, 0.0]) + [0.0, 0.0, 0.025]
            if task == "box":
                worlds.box_place[:] = place
            behind = np.outer(self.SIDES, [0.07, 0.0, 0.0])
            drive(worlds, lambda: worlds.object_position * [1, 1, 0] + behind + [0, 0, 0.12], 16)
            drive(worlds, lambda: worlds.object_position * [1, 1, 0] + behind + [0, 0, 0.02], 5)
            nearest = np.full(2, np.inf)
            for _ in range(20):
                drive(worlds, lambda: worlds.object_position * [1, 1, 0] - behind + [0, 0, 0.02], 1)
                distance = (worlds.object_position[:, 0] - place[0]) * self.SIDES
                nearest = np.minimum(nearest, distance)
            return nearest, distance

    def test_an_object_is_not_pushed_through_a_wall(self):
        nearest, at_last = self.pushed("wall", np.array([-0.05, 0.0, 0.0]))
        assert (nearest > 0.025 - 0.001).all()  # struck with 500 N it is 6 mm inside the wall of 10 mm
        assert_touched(at_last - 0.005)

    def test_an_object_is_not_pushed_into_a_box_and_no_box_is_pushed(self):
        nearest, at_last = self.pushed("box", np.array([-0.05, 0.05, 0.0]))
        assert_touched(nearest - 0.05)
        assert_touched(at_last - 0.05)

    def test_a_gripper_stands_on_a_wall_and_on_a_rim(self):
        for task, x, height in (("wall", 0.0, 0.07), ("box", 0.0475, 0.05)):
            with WorldBatch(TASKS[task].world_from(CONFIG), 1, num_threads=1) as worlds:
                worlds.reset(np.random.default_rng(0))
                worlds.object_position[:] = [-0.9, 0.3, 0.025]
                if task == "box":
                    worlds.box_place[:] = [-0.05, 0.0, 0.0]
                top = np.array([[-0.05 + x, 0.0, 0.12]])
                drive(worlds, lambda top=top: top, 8)
                drive(worlds, lambda top=top: top - [0.0, 0.0, 0.2], 10)
                # the fingertips end 7 mm below the end effector
                np.testing.assert_allclose(worlds.ee_position[0, 2] - 0.007, height, rtol=0, atol=0.003)

    def test_an_object_dropped_into_a_box_lies_on_its_bottom(self):
        with WorldBatch(TASKS["box"].world_from(CONFIG), 3, num_threads=1) as worlds:
            worlds.reset(np.random.default_rng(0))
            worlds.object_position[:] = worlds.box_place + np.array([0.01, -0.01, 0.08])
            away = worlds.ee_position + np.array([0.0, 0.0, 0.3])
            drive(worlds, lambda: away, 25)
            assert np.abs(worlds.object_position[:, 2] - 0.03).max() < 0.001


@pytest.mark.parametrize("task", TASKS)
def test_every_task_can_be_solved_in_its_time(task):
    assert play_task(task, CONFIG, num_episodes=20).mean() >= 0.9
    assert play_task(task, CONFIG, num_episodes=10, idle=True).mean() <= 0.2


@pytest.mark.parametrize("task", ["hard-inair", "hard-push"])
def test_a_hand_written_policy_solves_most_episodes_of_the_harder_ones(task):
    """It was written for a light cube that does not slip: two thirds have to do, in 80 steps."""
    assert play_task(task, CONFIG, num_episodes=25, num_steps=80).mean() >= 0.66
