"""The package by which programs name Tandem: cheap, complete, and clear about another ``service``."""

import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import tandem_skills
from service.base.errors import TandemError

ROOT = Path(__file__).parents[1]


def python(code, *, path=ROOT, where=None):
    environment = {**os.environ, "PYTHONPATH": str(path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, cwd=where, capture_output=True, text=True)
    return done.stdout + done.stderr


def test_importing_it_brings_nothing_heavy():
    code = "import sys, tandem_skills; print(sorted({'torch', 'mujoco', 'ray', 'pydantic'} & {*sys.modules}))"
    assert python(code) == "[]\n"


@pytest.mark.parametrize("name", tandem_skills.__all__)
def test_every_name_is_there(name):
    assert getattr(tandem_skills, name) is not None
    assert name in dir(tandem_skills)


def test_a_name_that_it_does_not_have():
    with pytest.raises(AttributeError, match="has no 'lod'; it has load, train"):
        tandem_skills.lod  # noqa: B018


def test_another_service_is_named(tmp_path):
    (tmp_path / "service.py").write_text("NAME = 'another'")
    said = python("import tandem_skills", where=tmp_path).splitlines()[-1]
    assert said.startswith("ImportError: tandem_skills needs its package 'service', and Python finds another: ")
    assert str(tmp_path / "service.py") in said


def test_a_policy_is_evaluated_in_an_environment_and_as_the_command_does(champion):
    found = tandem_skills.evaluate(champion, "push", num_episodes=5, seed=3)
    again = tandem_skills.evaluate(champion, tandem_skills.find_task("push"), num_episodes=5, seed=3)
    assert (again.success_last, again.num_steps) == (found.success_last, 50)
    assert (found.num_episodes, found.num_steps, found.goals) == (5, 50, "table")
    envs = tandem_skills.make_env("push", champion, num_envs=2)
    observation, _ = envs.reset(seed=0)
    assert observation["observation"].shape == (2, 11)
    assert envs.config.gripper == "blocked"
    joined = np.concatenate([observation["observation"], observation["desired_goal"]], axis=1)
    np.testing.assert_array_equal(champion.act_deterministic(observation), champion.act_deterministic(joined))
    np.testing.assert_array_equal(envs.step(np.zeros((2, 4), np.float32))[1] >= 0.0, [True, True])
    envs.close()


def test_a_reference_is_not_what_it_loads():
    said = "'panda-cube@champion', a str: give what tandem_skills.load returns"
    world = gymnasium.make("tandem/Tabletop-v1")
    for given in (
        lambda: tandem_skills.evaluate("panda-cube@champion"),
        lambda: tandem_skills.make_env("push", "panda-cube@champion"),
        lambda: tandem_skills.ComposePrimitives(world, "panda-cube@champion"),
    ):
        with pytest.raises(TandemError, match=said):
            given()
    world.close()


@pytest.mark.usefixtures("default_signals", "no_artifacts")
def test_training_is_what_the_command_does(tmp_path, monkeypatch):
    small = (
        "game.num_worlds=4", "game.alice_steps_min=2", "game.alice_steps=4", "game.bob_steps=4",
        "run.evaluation_interval=0", "run.final_episodes=2", "run.num_threads=1", "run.total_env_steps=1000000",
    )  # fmt: skip
    seen = []

    def twice(metrics):
        seen.append(metrics["iteration"])
        return "finished" if len(seen) == 2 else None

    done = tandem_skills.train("panda-cube", small, run_dir=tmp_path / "run", registry=tmp_path, on_iteration=twice)
    assert (done.reason, done.iteration, seen) == ("finished", 2, [1.0, 2.0])
    loaded = tandem_skills.load(str(tmp_path / "run"))
    assert loaded.kind == "primitives"


def test_what_train_does_not_take_is_said():
    for arguments, said in (
        ({"what": tandem_skills.find_task("push")}, "what is a Task"),
        ({"what": "push", "primitives": tandem_skills.load()}, "primitives is a Trained"),
    ):
        with pytest.raises(TandemError, match=said):
            tandem_skills.train(**arguments)


def test_a_task_that_never_began_cannot_be_resumed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(TandemError, match="runs/push-ours-0"):
        tandem_skills.train("push", resume=True)
