"""What is trained with two cubes: samples, hindsight, the live world, what it is asked for, and what refuses it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import service
from service.base.errors import TandemError
from service.cli.evaluate import parse_goals
from service.config import load_config, parse_config
from service.config.recipes import recipes
from service.envs.observations import Layouts, distances, each_object
from service.envs.tasks import find_task
from service.learner.replay import ReplayBuffer
from service.methods.task import Hindsight, _mixed
from service.methods.task_worlds import columns
from service.robot.play.game import Game
from service.robot.pybullet_robot import PyBulletParameters, world_of
from service.runs.train import open_run
from service.store.run_directory import RunDirectory
from tests.runs.runs import TREE, write_yaml

WORLD = TREE["world"] | {"objects": ["cube", "cube"], "object_size_m": 0.04}
WORLD |= {"workspace": {"length_x_m": 0.3, "length_y_m": 0.3}}
SHORT = ["run.total_env_steps=400", "run.evaluation_interval=1000", "run.final_episodes=4"]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    root = tmp_path_factory.mktemp("two")
    file = write_yaml(root / "two.yaml", TREE | {"world": WORLD})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.runs.train.make_artifacts", lambda *arguments: {})  # a video takes long
        service.train(file, SHORT, run_dir=root / "run", registry=root / "registry", publish=True)
    return root


@pytest.fixture
def two(path):
    return service.load(str(path / "run"))


def test_it_is_published_with_what_it_was_measured_on(path):
    found = service.load("tiny@1", registry=path / "registry")
    assert found.manifest.spaces["observation"] == 23
    assert {"evaluation/one_success_last", "evaluation/mixed_success_last"} <= found.manifest.metrics.keys()
    assert service.evaluate(found, goals="one", num_episodes=3).num_episodes == 3


def test_hindsight_takes_for_each_object_what_was_achieved_or_asked_for():
    achieved, asked = np.zeros((400, 6), np.float32), np.ones((400, 6), np.float32)
    taken = each_object(_mixed(achieved, asked, np.random.default_rng(0)))
    assert (taken[:, :, 0] == taken[:, :, 2]).all()
    achieved_too = (taken[:, :, 0] == 0.0).sum(axis=1)
    assert set(achieved_too.tolist()) == {1, 2}


def test_a_task_is_learned_with_them(path):
    small = ["sac.num_worlds=4", "sac.gradient_steps=2", "sac.batch_size=16", "sac.hidden_sizes=[8]"]
    small += ["sac.learning_starts=200", "run.total_env_steps=300", "run.final_episodes=3"]
    own = path / "both.py"
    own.write_text(
        "from tandem_skills import Task\n"
        "TASK = Task('Both', success=lambda s: (abs(s.objects.place - s.goal).max(axis=(1, 2)) < 0.05))\n"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.runs.train.make_artifacts", lambda *arguments: {})
        service.train(
            str(own), small, method="ours-her", primitives="tiny@1", registry=path / "registry",
            run_dir=path / "both",
        )  # fmt: skip
    assert service.load(str(path / "both"), registry=path / "registry").world.num_objects == 2


def test_the_live_world_has_a_goal_for_each(two):
    game = Game(two, seed=1)
    try:
        low, high = np.array(game.world.workspace.lower_m), np.array(game.world.workspace.upper_m)
        game.set_goal(np.array([9.0, 0.0, -1.0, -0.1, 0.1, 0.1]))
        np.testing.assert_allclose(game.goal, [high[0], 0.0, game.world.rest_height_m, -0.1, 0.1, 0.1])
        for mode in game.modes:
            game.set_mode(mode)
            for _ in range(12):
                game.step()
        assert (each_object(game.goal) >= low).all()
        assert distances(game.worlds.object_position, game.goal[None]).shape == (1, 2)
        steps = two.config.game.bob_steps
        for way_m, num in (([0.1, 0.0], 1), ([0.1, -0.1], 2), ([0.0, 0.0], 2)):  # of each object, along x
            game.set_mode("goals")
            game.reset()
            place = game.worlds.object_position[0].copy()
            game.goal = place + np.repeat(way_m, 3) * np.tile([1.0, 0.0, 0.0], 2)
            assert game._most_steps() == num * steps
    finally:
        game.close()


def test_distillation_keeps_who_is_alike(two, tmp_path):
    """Else its student would see the objects in another order than the teacher, and begin from nothing."""
    other = {"shape": "box", "size_m": [0.04, 0.04, 0.04], "mass_kg": 0.7}
    tree = {"method": "distillation", "world": WORLD | {"objects": ["cube", other]}, "policy": TREE["policy"]}
    with pytest.raises(
        TandemError, match=r"in its world other objects are alike than here, so it sees them in another"
    ):
        open_run(parse_config(tree, where="a test"), RunDirectory(tmp_path / "run"), start=two)


def test_goals_are_typed_for_all(two):
    found = parse_goals("-0.1,0,0.02,0.05,0.1,0.02", two.world)
    assert found.tolist() == [[-0.1, 0.0, 0.02, 0.05, 0.1, 0.02]]
    with pytest.raises(TandemError, match="points with ; between, each x,y,z,x,y,z in metres"):
        parse_goals("-0.1,0,0.02", two.world)
    with pytest.raises(TandemError, match="outside of the workspace"):
        parse_goals("-0.1,0,0.02,0.9,0.1,0.02", two.world)
    with pytest.raises(TandemError, match=r"025, -0\.070, 0\.000, 0\.025 objects would be inside each other"):
        parse_goals("-0.1,0,0.025,-0.07,0,0.025", two.world)


def test_who_knows_one_object_says_so(two):
    with pytest.raises(TandemError, match=r"world\.objects: PyBullet has one cube only"):
        world_of(two.world, PyBulletParameters())
    more = replace(find_task("push"), world={"objects": ["cube", "cube"]})
    with pytest.raises(TandemError, match="was trained in a world of 1 object, and Push has 2"):
        service.load().playing(more)
    with pytest.raises(TandemError, match="skill discovery moves one object"):
        load_config(recipes()["panda-cube-lsd"], ["world.objects=[cube,cube]"])


def test_a_relabelled_goal_has_the_place_that_at_least_one_object_came_to():
    """Everything that was achieved is at 0, everything that was asked at 1."""
    seen, num = Layouts(num_objects=2), 200
    sizes = {**columns(seen), "action": 4}
    replay = ReplayBuffer(5, num, sizes)
    rows = {name: np.zeros((num, size), np.float32) for name, size in sizes.items()}
    rows["goal"] += 1.0
    for step in range(5):
        replay.add(rows, np.full(num, step == 4))
    relabelled = []
    worlds = SimpleNamespace(seen=seen, rewards=lambda rows, goal: relabelled.append(goal) or np.zeros(len(goal)))
    Hindsight(worlds, (1.0, 1.0))(replay, 400, np.random.default_rng(0))
    achieved = relabelled[0].reshape(-1, 2, 3)[:, :, 0] == 0.0
    assert set(achieved.sum(axis=1).tolist()) == {1, 2}
