"""A task from a user's file goes the way of ours: trained, killed, resumed, evaluated, published, loaded."""

import dataclasses
import pickle
import subprocess
import sys

import numpy as np
import pytest

from service.base.errors import TandemError
from service.config import load_config
from service.envs.gym.vector import TabletopVectorEnv
from service.envs.task import Task
from service.envs.tasks import find_task
from service.methods import task_check
from service.methods.task_check import check_task
from service.registry.bundled import BUNDLED
from service.registry.loading import load
from service.registry.publishing import publish
from service.registry.registry import Registry
from service.runs.resuming import resumed_config
from service.runs.train import train
from service.store.run_directory import RunDirectory
from tests.cli.typed import tandem
from tests.envs.test_meshes import write_box
from tests.runs.runs import KilledError, assert_one_line, assert_same_run

pytestmark = pytest.mark.usefixtures("default_signals", "no_artifacts")
CODE = """
import numpy as np
from service.envs.task import Task

def near(s):
    return np.linalg.norm(s.objects[:, 0].place - s.gripper, axis=1) < 0.06

TASK = Task(
    "Stay near",
    "the gripper stays near the cube",
    goals=lambda s, rng: s.objects.place + [0.0, 0.06, 0.0],
    success=lambda s: s.memory[:, 0] >= 3,
    reward=lambda s: near(s).astype(float),
    remember=lambda s: np.where(near(s)[:, None], s.memory + 1, 0),
    memory_size=1,
    episode_steps=8,
)
"""
SMALL = (
    "method=ours-her", "sac.num_worlds=4", "sac.batch_size=16", "sac.hidden_sizes=[8]", "sac.learning_starts=32",
    "sac.gradient_steps=1", "run.total_env_steps=192", "run.checkpoint_interval=2", "run.evaluation_interval=2",
    "run.evaluation_episodes=2", "run.final_episodes=4", "run.num_threads=1",
)  # fmt: skip


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stay_near.py").write_text(CODE)
    return tmp_path / "stay_near.py"


def evaluated(reference, registry, *more):
    """What the command prints, and its exit code."""
    done = tandem("evaluate", reference, "--episodes", "4", "--registry", registry, *more)
    return done.output, done.exit_code


def begun(registry, *overrides):
    return load_config(None, ["task=stay_near.py", *SMALL, *overrides]).begin(registry, None)


def test_it_is_trained_killed_resumed_evaluated_and_published(file, tmp_path, caplog):
    def kill(metrics):
        if metrics["iteration"] == 5:
            raise KilledError

    registry = tmp_path / "registry"
    config = begun(registry)
    assert (config.name, config.episode_steps, config.code) == ("stay_near-ours-her", 8, {"stay_near.py": CODE})
    train(config, RunDirectory(tmp_path / "whole"), registry, publish=False, on_iteration=lambda _: None)
    with pytest.raises(KilledError):
        train(config, RunDirectory(tmp_path / "cut"), registry, publish=False, on_iteration=kill)
    file.write_text(CODE.replace("0.06", "0.6"))
    directory = RunDirectory(tmp_path / "cut")
    train(resumed_config(directory, []), directory, registry, resume=True, publish=False, on_iteration=lambda _: None)
    assert "stay_near.py has another text by now than the configuration of this run" in caplog.text
    assert_same_run(tmp_path / "whole", tmp_path / "cut")
    file.unlink()
    found = load(str(tmp_path / "whole"), registry)
    assert (found.task.title, found.num_steps, found.task.success is None) == ("Stay near", 8, False)
    assert evaluated(tmp_path / "whole", registry)[1] == 0
    version = publish(Registry(registry), config, found.parameters, {})
    closed = load(str(version), registry)
    assert (closed.task.name, closed.num_steps, closed.task.success) == ("stay_near.py", 8, None)
    observation = np.zeros((1, 14), dtype=np.float32)
    np.testing.assert_array_equal(closed.act_deterministic(observation), found.player().act_deterministic(observation))
    refused, code = evaluated(version, registry)
    assert "what counts is said by code of its publisher, stay_near.py" in " ".join(refused.split())
    assert code == 2
    told, code = evaluated(version, registry, "--run-task-code")
    assert "of Stay near (its own), 8 steps, success as the task says" in told
    assert code == 0


def test_a_mesh_of_its_world_is_recorded_as_it_was_when_the_run_began(file, tmp_path, monkeypatch):
    write_box(tmp_path / "brick.obj", (0.06, 0.04, 0.04))
    world = '    world={"object": {"shape": "mesh", "mesh": {"pieces": ["brick.obj"]}}},\n    episode_steps'
    file.write_text(CODE.replace("    episode_steps", world))
    registry, path = tmp_path / "registry", tmp_path / "run"
    train(begun(registry), RunDirectory(path), registry, publish=False, on_iteration=lambda _: None)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    found = load(path, registry)
    version = str(publish(Registry(registry), found.config, found.parameters, {}))
    worlds = [found.world, *(load(version, registry, run_task_code=run).world for run in (False, True))]
    for world in worlds:
        assert world.shape.extent_m == pytest.approx((0.06, 0.04, 0.04))
    write_box(tmp_path / "brick.obj", (0.1, 0.02, 0.02))
    for reference, *more in ((path,), (version, "--run-task-code")):
        told, code = evaluated(reference, registry, *more)
        assert "brick.obj" in told
        assert code == 2


def test_another_process_gets_a_task_with_its_functions(file, tmp_path):
    (tmp_path / "pickled").write_bytes(pickle.dumps(dataclasses.replace(find_task("stay_near.py"), episode_steps=9)))
    file.unlink()
    lines = (
        "import pickle, sys, numpy as np",
        "from service.envs.gym.vector import TabletopVectorEnv",
        "task = pickle.load(open(sys.argv[1], 'rb'))",
        "env = TabletopVectorEnv(2, task=task, num_threads=1)",
        "print(task.episode_steps, task.name, env.reset(seed=0)[0]['desired_goal'].tolist())",
    )
    command = (sys.executable, "-c", "\n".join(lines), str(tmp_path / "pickled"))
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    env = TabletopVectorEnv(
        2, task=Task("Same", goals=lambda s, rng: s.objects.place + np.array([0.0, 0.06, 0.0])), num_threads=1
    )
    assert told == f"9 stay_near.py {env.reset(seed=0)[0]['desired_goal'].tolist()}\n"
    env.close()


def test_primitives_that_moved_are_named_at_a_resume(file, tmp_path):
    registry = tmp_path / "registry"
    load("panda-cube@champion", registry)
    exported = tmp_path / "primitives"
    Registry(BUNDLED).export("panda-cube@champion", exported)
    config = begun(registry, f"primitives={exported}")
    train(config, RunDirectory(tmp_path / "run"), registry, publish=False, on_iteration=lambda _: None)
    exported.rename(tmp_path / "moved")
    directory = RunDirectory(tmp_path / "run")
    overrides = ["primitives=./moved", "run.total_env_steps=256"]
    done = train(
        resumed_config(directory, overrides), directory, registry, resume=True, publish=False,
        on_iteration=lambda _: None,
    )  # fmt: skip
    assert done.num_env_steps == 256
    assert directory.read_config().primitives == str(tmp_path / "moved")


def test_a_method_that_takes_no_primitives_keeps_those_it_names(file, tmp_path):
    registry = tmp_path / "registry"
    directory = RunDirectory(tmp_path / "run")
    directory.start(begun(registry, "method=scratch-mcp-her"))
    directory.close()
    with pytest.raises(TandemError) as error:
        resumed_config(RunDirectory(tmp_path / "run"), ["primitives=panda-cube-robust@champion"])
    assert_one_line(
        error.value, "primitives = 'panda-cube-robust@champion', but the run has 'panda-cube@", "leave it out"
    )


def test_hindsight_pays_as_the_task_does(file, tmp_path):
    run = begun(tmp_path / "registry").build(tmp_path / "registry", None)
    run.loop.play(64)
    places = run.loop.replay.draw(50, np.random.default_rng(0))
    rows = run.loop.replay.read(places)
    near = np.linalg.norm(rows["following"][:, 5:8] - rows["following"][:, :3], axis=1) < 0.06
    np.testing.assert_array_equal(rows["reward"][:, 0] > 0, near)
    other = np.zeros((50, 3), dtype=np.float32)
    np.testing.assert_array_equal(run.loop.worlds.rewards(rows, other) > 0, near)
    run.close()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("TASK = Task(", "TASK = Tusk(", "stay_near.py:8: NameError: name 'Tusk' is not defined"),
        ("s.gripper, axis", "s.griper, axis", "stay_near.py:6: AttributeError: "),
        ("reward=lambda s: near(s)", "reward=lambda s: s.memory[:, 0]", "for another goal: hindsight asks"),
        (">= 3", ">= -1", "stay_near.py:12: success is true at the start of every episode; is that meant?"),
        ("objects[:, 0]", "objects[:, 1]", "stay_near.py:6: IndexError: "),
        ("[0.0, 0.06, 0.0]", "[0.0, 6.0, 0.0]", "m, out of reach, or inside the table; choose others"),
        ("< 0.06", "< 0.0", "success in 0 % of 64 random episodes, and in 0 % where the object goes straight"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_before_anything_is_learned(file, tmp_path, caplog, old, new, said):
    assert old in CODE
    file.write_text(CODE.replace(old, new))
    if "is that meant" in said or "0 %" in said:  # a warning: it may be meant
        begun(tmp_path / "registry")
        assert said in caplog.text
    else:
        with pytest.raises(TandemError) as error:
            begun(tmp_path / "registry")
        assert_one_line(error.value, said)


def test_the_examples_of_the_docs_run(monkeypatch):
    monkeypatch.setattr(task_check, "_NUM_WORLDS", 8)
    for name in ("lift_and_hold", "push_along_a_line"):
        task = find_task(f"docs/examples/{name}.py")
        check_task(task, load_config(None, []).world, relabels=name == "lift_and_hold")
        assert task.memory_size == 1


def test_a_reward_that_compares_memory_is_refused_with_hindsight(file, tmp_path):
    """Of other goals no memory is known, and a comparison with it would be false without a word."""
    file.write_text(CODE.replace("reward=lambda s: near(s)", "reward=lambda s: near(s) * (s.memory == 0)[:, 0]"))
    with pytest.raises(TandemError, match="for another goal: hindsight asks"):
        begun(tmp_path / "registry")


def test_hindsight_asks_for_where_the_object_was_not_for_where_it_was_seen(file, tmp_path):
    there = "np.linalg.norm(s.objects[:, 0].place - s.goal[:, 0], axis=1) < 0.01"
    file.write_text(CODE.replace("reward=lambda s: near(s).astype(float)", f"reward=lambda s: ({there}).astype(float)"))
    run = begun(tmp_path / "registry").build(tmp_path / "registry", None)
    run.loop.play(64)
    run.loop.replay._columns["following"] += 0.5  # where it is seen, by a camera that is off
    run.loop.make_batch.share = 1.0
    assert run.loop.make_batch(run.loop.replay, 200, np.random.default_rng(0)).rewards.mean() > 0.5


def test_a_task_that_shows_policies_something_else_is_refused(file, tmp_path):
    file.write_text(CODE.replace("memory_size=1,", "memory_size=1, world={'observed': {'num_commands': 2}},"))
    with pytest.raises(TandemError, match="positions, and in the world of Stay near there are"):
        begun(tmp_path / "registry")
