import contextlib
import json
import os
import signal
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from service.base.errors import RobotError, TandemError
from service.base.jsonl import read_jsonl
from service.cli.robot import parse_goal
from service.config import WorldConfig
from service.config.self_play import SelfPlayConfig
from service.media import video
from service.registry.loading import Trained
from service.robot.backends import Backend
from service.robot.loop import Bridge, BridgeConfig
from service.robot.running import play, read_log
from tests.cli.typed import assert_refused, tandem
from tests.robot.fakes import FakeRobot, Steady

FAST = ["--set", "set_points_per_step=2"]
invoke = partial(tandem, "robot")


@pytest.fixture(autouse=True)
def nowhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TANDEM_REGISTRY", raising=False)


def test_goals_are_played_logged_and_drawn_from_the_log(tmp_path, monkeypatch):
    log = tmp_path / "log.jsonl"
    ran = invoke(
        "run", "--robot", "mujoco", "--goal=-0.1,0.05,0.2", "--episodes", 2, "--steps", 6, "--log", log, "--json", *FAST
    )
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout) == {"policy": "panda-cube@7 (bundled)", "robot": "mujoco", "reached": 0, "goals": 2}
    header, *rows = read_jsonl(log)
    assert header["bridge"]["set_points_per_step"] == 2
    assert (header["seed"], header["dry_run"], header["gain"]) == (0, False, [1.0, 1.0, 1.0])
    assert [rows.pop(6)["reached"], rows.pop()["reached"]] == [False, False]  # what came of each goal
    assert [(row["episode"], row["step"]) for row in rows] == [
        (episode, step) for episode in (0, 1) for step in range(6)
    ]
    row = rows[9]
    assert len(row["set_points_m"]) == len(row["measured_m"]) == 2
    world, drawn = read_log(log)
    assert drawn.states.shape[:2] == (6, 2)
    from service.envs.batch import WorldBatch

    with WorldBatch(world, 2, num_threads=1) as worlds:
        worlds.restore(drawn.states[3])
        np.testing.assert_allclose(worlds.ee_position[1], row["effector_m"], atol=1e-3)
        np.testing.assert_allclose(worlds.object_position[1], row["object_m"])
    filmed = []
    monkeypatch.setattr(video, "write_episode_video", lambda *given: filmed.append(given))
    assert invoke("replay", log, "--out", "film.mp4").exit_code == 0
    ((episodes, scene, out),) = filmed
    np.testing.assert_array_equal(episodes.states, drawn.states)
    assert (scene, out) == (world, Path("film.mp4"))
    assert_refused(invoke("replay", log, "--out", tmp_path), "Is a directory")
    again = invoke("run", "--robot", "mujoco", "--log", log)
    assert_refused(again, "there is a file already; name another")


def test_two_cubes_have_a_goal_each_and_are_drawn_where_they_were(tmp_path):
    goal, log = "--goal=-0.1,0.05,0.2,0.05,-0.1,0.025", tmp_path / "log.jsonl"
    two = ("--policy", "panda-two-cubes@champion", "--steps", 3)
    ran = invoke("run", "--robot", "mujoco", goal, "--log", log, *two, *FAST)
    assert ran.exit_code == 0, ran.output
    assert "goal -0.100, 0.050, 0.200, 0.050, -0.100, 0.025: not reached" in ran.stdout
    row = read_jsonl(log)[3]
    world, drawn = read_log(log)
    from service.envs.batch import WorldBatch

    with WorldBatch(world, 1, num_threads=1) as worlds:
        worlds.restore(drawn.states[2])
        np.testing.assert_allclose(worlds.object_position[0], row["object_m"])
    assert drawn.goal.shape == (1, 6)
    assert_refused(
        invoke("run", "--robot", "mujoco", goal.replace("0.025", "0.02"), *two),
        "is inside the table: a goal is for the object's centre, which lies 0.025 and 0.025 m high there",
    )


def test_a_dry_run_says_where_it_would_go_and_moves_nothing():
    ran = invoke("run", "--robot", "mujoco", "--dry-run", "--steps", 2, *FAST)
    assert ran.exit_code == 0, ran.output
    first, second, _ = ran.stdout.splitlines()
    assert "gripper -0.050, 0.000, 0.080" in first
    assert "gripper -0.050, 0.000, 0.080" in second
    assert "would go to" in first


def test_what_calibrate_writes_run_reads(tmp_path, monkeypatch):
    out = tmp_path / "arm.yaml"
    with monkeypatch.context() as patch:
        patch.setattr("service.robot.calibrate.calibrate", None)  # it is refused before the arm moves
        assert_refused(invoke("calibrate", "--robot", "mujoco", "--out", tmp_path, *FAST), "Is a directory")
    (tmp_path / "mine.yaml").write_text("backend: mujoco\nname: mine\nparameters: {feed_forward: 1.0}\n")
    made = invoke("calibrate", "--robot", "mine.yaml", "--out", out, *FAST)
    assert made.exit_code == 0, made.output
    found = yaml.safe_load(out.read_text())
    assert found["robot"] == "mine"
    assert all(0.55 < share < 0.62 for share in found["training_share"])
    assert all(0.9 < share < 1.05 for share in found["covered_share"])
    assert 0.0 < found["delay_steps"] < 1.5
    ran = invoke("run", "--robot", "mine.yaml", "--calibration", out, "--steps", 2, *FAST)
    assert ran.exit_code == 0, ran.output
    other = invoke("run", "--robot", "mujoco", "--calibration", out, *FAST)
    assert_refused(other, "error: calibration: measured with robot 'mine', not 'mujoco': calibrate again\n")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["--robot", "mujocco"],
            "unknown robot 'mujocco': name mujoco, pybullet, franka, module:function of your own, or a "
            "YAML file; did you mean 'mujoco'?",
        ),
        (["--robot", "gone.yaml"], "no file gone.yaml: name a YAML file of a robot, or one of mujoco"),
        (["--robot", "mujoco", "--goal", "1,2,3"], "--goal: 1.000, 2.000, 3.000 is outside of the workspace"),
        (["--robot", "mujoco", "--goal", "here"], "--goal 'here': write a point x,y,z in metres\n"),
        (["--robot", "mujoco", "--goal", "0,0,0.02"], "--goal: 0.000, 0.000, 0.020 is inside the table"),
        (["--robot", "mujoco", "--goal", "0,0,0.2;0,0,0.1"], "0,0,0.1: write one point"),
        (["--robot", "mujoco", "--policy", "nobody@1"], "nobody"),
        (["--robot", "mujoco", "--set", "safety.max_speed=1"], "--set: unknown key 'safety.max_speed'; known there: "),
        (["--robot", "mujoco", "--set", "safety.lowest_m=0.49"], "m is empty: raise upper_m, or lower"),
        (["--robot", "mujoco", "--calibration", "none.yaml"], "no calibration none.yaml: tandem robot calibrate --out"),
        (["--robot", "mujoco", "--dead-man", "button"], "choose key or none"),
    ],
)
def test_what_cannot_be_run_is_one_line(arguments, said):
    assert_refused(invoke("run", *arguments), said)


ARM = """
from service.robot.backends import Backend

class Arm:
    def read(self):
        return self.finger

    def close(self): ...

def connect(world, parameters):
    return Backend(Arm(), Arm())
"""
REST = "def now_s(self): return 0.0\n    command = wait_until = stop = close"


def test_what_is_wrong_in_a_back_end_of_a_users_is_said_with_its_line(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "half_an_arm.py").write_text(ARM)
    words = "'half_an_arm:connect': Arm has no now_s, command, wait_until, stop, which service.robot.interface.RobotInt"
    assert_refused(invoke("run", "--robot", "half_an_arm:connect", "--dry-run"), words)
    (tmp_path / "an_arm.py").write_text(ARM.replace("def close", f"{REST} = lambda *_: None\n    def close"))
    said = "an_arm.py:6: AttributeError: 'Arm' object has no attribute 'finger'"
    assert_refused(invoke("run", "--robot", "an_arm:connect", "--dry-run"), said)


def test_a_goal_inside_the_wall_is_refused_and_one_behind_it_is_not():
    wall = WorldConfig(fixture="wall")
    with pytest.raises(TandemError, match=r"^--goal: at -0\.050, 0\.000, 0\.025 an object would be inside a fixture"):
        parse_goal("-0.05,0,0.025", wall)
    np.testing.assert_array_equal(parse_goal("0.125,0,0.025", wall), [0.125, 0.0, 0.025])  # at the very edge


def test_a_robot_that_cannot_know_where_the_box_is_wants_a_goal():
    robot, world = FakeRobot(), WorldConfig(fixture="box")
    policy = Trained("into-it", "primitives", SelfPlayConfig(world=world), Steady([0.1, 0.0, 0.0, 0.0]), {})
    bridge = Bridge(policy.policy, robot, robot.poses, world, BridgeConfig())
    given = {"num_episodes": 1, "num_steps": 2, "seed": 0, "ready": lambda episode, goal_m: None}
    with pytest.raises(RobotError, match=r"into-it brings the object into a box, .*: --goal"):
        next(play(bridge, Backend(robot, robot.poses), policy, goal_m=None, **given))
    assert robot.commands == []
    goal_m = np.array([0.0, 0.0, 0.025])
    assert next(play(bridge, Backend(robot, robot.poses), policy, goal_m=goal_m, **given)).distance_m > 0.0


def real(robot):
    """A back-end with people around it."""
    return lambda world, parameters: Backend(robot, robot.poses)


def test_a_real_robot_wants_a_dead_mans_switch_and_a_person(monkeypatch):
    robot = FakeRobot()
    monkeypatch.setitem(sys.modules, "their", SimpleNamespace(robot=real(robot)))
    without = invoke("run", "--robot", "their:robot", "--goal", "0,0,0.2", "--log", "log.jsonl")
    assert_refused(without, "the dead-man's switch is a key")
    assert not Path("log.jsonl").exists()  # the same words work once there is a terminal
    assert robot.commands == []
    dry = invoke("run", "--robot", "their:robot", "--goal", "0,0,0.2", "--steps", "2", "--dry-run", "--json")
    assert dry.exit_code == 0, dry.output
    assert json.loads(dry.stdout)["goals"] == 1
    assert dry.stderr.count("would go to") == 2
    assert robot.commands == robot.stops == []
    asked = ("run", "--robot", "their:robot", "--goal", "0,0,0.2", "--steps", "3", "--dead-man", "none")
    alone = invoke(*asked, answers="")
    assert alone.exit_code == 2, alone.output
    assert alone.stderr.endswith("error: standard input has ended, so nobody can press Enter: run this in a terminal\n")
    assert robot.commands == []
    ran = invoke(*asked, answers="\n")
    assert ran.exit_code == 0, ran.output
    assert "put arm and objects to their start, then press Enter" in ran.stderr
    assert robot.commands


def test_a_key_that_a_simulator_is_given_is_waited_for(monkeypatch):
    class Key(contextlib.nullcontext):
        held = False

        def __enter__(self):
            return self

        def wait(self):
            self.held = True

        def __call__(self):
            return self.held

    monkeypatch.setattr("service.robot.watchdogs.HeldKey", Key)
    ran = invoke("run", "--robot", "mujoco", "--dead-man", "key", "--steps", 1, *FAST)
    assert ran.exit_code == 0, ran.output
    assert "then hold any key; letting go stops the robot" in ran.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
@pytest.mark.parametrize("swallowed", [False, True])
def test_a_signal_stops_the_robot_first(monkeypatch, default_signals, number, swallowed):
    robot, closed = FakeRobot(), []
    command = robot.command

    def interrupted(sent):
        command(sent)
        if len(robot.commands) == 5:
            with contextlib.suppress(BaseException) if swallowed else contextlib.nullcontext():
                os.kill(os.getpid(), number)

    robot.command, robot.close = interrupted, lambda: closed.append(len(robot.stops))
    monkeypatch.setitem(sys.modules, "their", SimpleNamespace(robot=real(robot)))
    ran = invoke("run", "--robot", "their:robot", "--goal", "0,0,0.2", "--dead-man", "none", answers="\n")
    assert ran.exit_code == 128 + number
    assert len(robot.commands) == 5
    assert len(closed) == 1
    assert closed[0] > 0  # it was stopped, then given back
