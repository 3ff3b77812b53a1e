from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from service.base.errors import RobotError, TandemError
from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.overlap import inside_gripper_or_table
from service.envs.sampling import draw_first, draw_goals
from service.envs.task import Task
from service.registry.bundled import BUNDLED
from service.registry.loading import load
from service.robot.interface import ObjectPose
from service.robot.running import for_robot, play, read_log
from tests.export.policies import publish_bob, write_training
from tests.methods.skill_sets import made


def test_a_bob_and_an_orchestrator_with_its_world(registry, tmp_path):
    bob = for_robot(load("panda-cube@champion", tmp_path))
    assert (bob.goal_kind, bob.world.fixture) == ("mixed", "none")
    robust = for_robot(load("panda-cube-robust@champion", tmp_path)).world
    assert (robust.nominal, robust.observed.delay) == (robust, True)  # a robot is one, not drawn from many
    write_training(tmp_path / "wall", publish_bob(registry), "ours", "wall")
    found = for_robot(load(str(tmp_path / "wall"), registry.root))
    assert (found.name, found.tried_on.goals, found.world.fixture) == ("wall-ours-0", "table", "wall")
    action = found.policy.act_deterministic(np.zeros((1, 22), dtype=np.float32))
    assert action.shape == (1, 4)


def test_what_is_no_policy_for_a_robot(champion, tmp_path):
    write_training(tmp_path / "alone", champion, "scratch-mcp-her")
    with pytest.raises(TandemError, match="acts without primitives"):
        for_robot(load(str(tmp_path / "alone"), BUNDLED))
    with pytest.raises(TandemError, match="made@1 is a set of skills of lsd; tandem robot needs primitives"):
        for_robot(made())


@pytest.mark.parametrize("text", ["game: {bob_steps: 3}\n", "", "{}\n"])
def test_what_is_no_log_of_a_robot(text, tmp_path):
    (tmp_path / "log").write_text(text)
    with pytest.raises(TandemError, match="is no log of tandem robot run, format 1; name what --log wrote"):
        read_log(tmp_path / "log")


def test_a_policy_of_a_users_task_plays_goals_of_the_nearest_kind(tmp_path):
    """Of what is published a robot runs no code."""
    task = Task("Mine", goals="air", closed="code of its publisher")
    policy = replace(for_robot(load("panda-cube@champion", tmp_path)), task=task)
    bridge = SimpleNamespace(run=lambda goal_m, num_steps, truth: 0.04)
    given = {"goal_m": None, "num_episodes": 5, "num_steps": 1, "seed": 0, "ready": lambda episode, goal_m: None}
    outcomes = list(play(bridge, SimpleNamespace(simulator=None, begin=lambda object_m: None), policy, **given))
    assert [outcome.reached for outcome in outcomes] == [True] * 5
    assert min(outcome.goal_m[2] for outcome in outcomes) > 0.075


@pytest.mark.parametrize("height_m", [0.05, 0.15])
def test_a_simulators_object_starts_as_in_training(height_m, tmp_path):
    """Beside the gripper where it is so high that it would start inside; else wherever it did before."""
    found = for_robot(load("panda-cube@champion", tmp_path))
    world = WorldConfig(object={"shape": "box", "size_m": (0.05, 0.05, height_m)})
    policy, begun = replace(found, config=found.config.model_copy(update={"world": world})), []
    simulator = SimpleNamespace(object_position=lambda: np.zeros(3))
    backend = SimpleNamespace(simulator=simulator, begin=begun.append)
    bridge = SimpleNamespace(run=lambda goal_m, num_steps, truth: float(np.linalg.norm(truth() - goal_m)))
    given = {"goal_m": None, "num_episodes": 30, "num_steps": 1, "seed": 3, "ready": lambda episode, goal_m: None}
    goals = [outcome.goal_m for outcome in play(bridge, backend, policy, **given)]
    rng = np.random.default_rng(3)
    with WorldBatch(world, 1, num_threads=1) as worlds:
        clear = ~inside_gripper_or_table(np.array(begun), world, worlds.gripper_at_start, worlds.rest_heights)
    assert clear.all()
    anywhere = draw_first(rng, 30, world)
    same = (anywhere.object == begun).all(axis=1)
    assert same.sum() == 30 if height_m < 0.07 else 15 < same.sum() < 30
    if same.all():
        np.testing.assert_array_equal(goals, draw_goals("mixed", rng, world, policy.success_distance_m, anywhere))


def test_on_a_real_robot_the_other_object_stays_where_it_is_seen(tmp_path):
    policy = replace(for_robot(load("panda-two-cubes@champion", tmp_path)), task=Task("One", goals="one"))
    before, seen = np.full(6, np.nan), np.array([0.0, 0.1, 0.025, 0.05, -0.1, 0.025])
    lying = [before]

    def put_back(episode, goal_m):
        assert goal_m is None  # it is drawn from where they are put
        lying[0] = seen

    backend = SimpleNamespace(
        simulator=None,
        begin=lambda object_m: lying.__setitem__(0, before),
        poses=SimpleNamespace(read=lambda: ObjectPose(0.0, lying[0])),
    )
    bridge = SimpleNamespace(run=lambda goal_m, num_steps, truth: 0.0)
    given = {"goal_m": None, "num_episodes": 20, "num_steps": 1, "seed": 0, "ready": put_back}
    goals = np.array([outcome.goal_m for outcome in play(bridge, backend, policy, **given)])
    stays = (goals == seen).reshape(20, 2, 3).all(axis=2)
    assert (stays.sum(axis=1) == 1).all()
    assert stays.any(axis=0).all()


@pytest.mark.parametrize("pose", [None, ObjectPose(0.0, np.full(6, np.nan)), ObjectPose(0.0, np.zeros(3))])
def test_a_goal_that_depends_on_what_is_not_seen(tmp_path, pose):
    policy = replace(for_robot(load("panda-two-cubes@champion", tmp_path)), task=Task("One", goals="one"))
    poses = SimpleNamespace(read=lambda: pose)
    backend = SimpleNamespace(simulator=None, begin=lambda object_m: None, poses=poses)
    given = {"goal_m": None, "num_episodes": 1, "num_steps": 1, "seed": 0, "ready": lambda episode, goal_m: None}
    with pytest.raises(RobotError, match="an object is not seen: put it on the table"):
        next(play(SimpleNamespace(), backend, policy, **given))
