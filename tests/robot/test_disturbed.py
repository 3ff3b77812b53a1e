from types import SimpleNamespace

import numpy as np
import pytest

from service.base.errors import TandemError
from service.config.world import WorldConfig
from service.robot.backends import Backend, BackendConfig, connect, read_backend
from service.robot.disturbed import DisturbanceConfig, DisturbedPoses, DisturbedRobot
from service.robot.interface import Command
from tests.robot.fakes import HOME_M, OBJECT_M, FakeRobot


def test_commands_and_states_come_as_late_as_asked():
    inner = FakeRobot()
    robot = DisturbedRobot(inner, DisturbanceConfig(state_delay_s=0.04, command_delay_s=0.02))
    seen = []
    for tick in range(30):
        robot.command(Command(np.array([tick, 0.0, 0.0]), 0.0))
        seen.append((robot.now_s(), robot.read().time_s))
        robot.wait_until(0.004 * (tick + 1))
    for time_s, command in inner.commands:
        assert time_s == pytest.approx(0.004 * command.effector_m[0] + 0.02)
    assert len(inner.commands) == 26  # the last ones are still on their way
    assert all(state_s == pytest.approx(now_s - 0.04) for now_s, state_s in seen)
    robot.stop()
    robot.wait_until(1.0)
    assert len(inner.commands) == 26
    assert inner.stops == [pytest.approx(0.12)]


def test_poses_are_late_noisy_and_off_alike_for_a_seed():
    config = DisturbanceConfig(pose_delay_s=0.04, pose_noise_m=0.005, pose_offset_m=(0.01, 0.0, -0.02))

    def read(seed, reads_per_tick=1):
        robot = FakeRobot()
        poses = DisturbedPoses(robot.poses, robot.now_s, config, seed=seed)
        found = []
        for tick in range(2000):
            found.append([poses.read() for _ in range(reads_per_tick)][-1])
            robot.wait_until(0.004 * (tick + 1))
        return np.array([pose.position_m for pose in found]), np.array([pose.time_s for pose in found])

    places, times = read(0)
    np.testing.assert_allclose(times, 0.004 * np.arange(-10, 1990), atol=1e-9)
    np.testing.assert_allclose(places.mean(axis=0) - OBJECT_M, config.pose_offset_m, atol=5e-4)
    np.testing.assert_allclose(places.std(axis=0), 0.005, rtol=0.05)
    np.testing.assert_array_equal(read(0, reads_per_tick=3)[0], places)  # a pose that is read again stays what it was
    assert (read(1)[0] != places).any()


def test_two_objects_have_noise_of_their_own_and_the_same_offset():
    robot = FakeRobot()
    robot.poses.position_m = np.concatenate((OBJECT_M, HOME_M))
    config = DisturbanceConfig(pose_noise_m=0.005, pose_offset_m=(0.01, 0.0, -0.02))
    poses, found = DisturbedPoses(robot.poses, robot.now_s, config, num_objects=2), []
    for _ in range(2000):
        robot.advance(0.004)
        found.append(poses.read().position_m)
    away = np.array(found) - robot.poses.position_m
    np.testing.assert_allclose(away.mean(axis=0), [0.01, 0.0, -0.02] * 2, atol=5e-4)
    assert np.abs(np.corrcoef(away.T) - np.eye(6)).max() < 0.1
    robot.poses.position_m = np.zeros((2, 3))
    assert poses.read().position_m.shape == (2, 3)  # what is wrong with it is the watchdog's to say


def test_a_new_start_knows_nothing_of_the_episode_before():
    late = {"state_delay_s": 0.04, "pose_delay_s": 0.04, "command_delay_s": 0.04}
    backend = connect(BackendConfig(backend="mujoco", disturbance=late), WorldConfig())
    robot, home = backend.robot, backend.robot.read().effector_m

    def moved_m(duration_s):
        for _ in range(round(duration_s / 0.01)):
            robot.read()
            robot.wait_until(robot.now_s() + 0.01)
        return np.linalg.norm(robot.read().effector_m - home)

    for place in ([0.0, 0.1, 0.025], [0.1, -0.1, 0.025]):
        backend.begin(np.array(place))
        np.testing.assert_allclose(backend.poses.read().position_m, place, atol=1e-6)
        assert moved_m(0.2) < 2e-3
        robot.command(Command(home + 0.05, 0.0))
        assert moved_m(0.12) > 5e-3
        robot.command(Command(home + 0.1, 0.0))  # is still on its way when the next episode begins


def test_a_robot_that_is_no_simulator_forgets_what_was_on_its_way_too():
    inner = FakeRobot()
    robot = DisturbedRobot(inner, DisturbanceConfig(command_delay_s=0.02))
    backend = Backend(robot, inner.poses)
    robot.command(Command(HOME_M + 0.1, 0.0))
    backend.begin(OBJECT_M)
    robot.wait_until(1.0)
    assert inner.commands == []


def test_the_robot_is_given_back_whatever_its_camera_does():
    closed = []

    def fail():
        closed.append("camera")
        raise OSError("gone")

    backend = Backend(SimpleNamespace(close=lambda: closed.append("robot")), SimpleNamespace(close=fail))
    with pytest.raises(OSError, match="gone"):
        backend.close()
    assert closed == ["robot", "camera"]


def test_back_ends_by_name_file_and_function(tmp_path):
    assert read_backend("mujoco") == BackendConfig(backend="mujoco")
    file = tmp_path / "late.yaml"
    file.write_text("backend: mujoco\nname: late\ndisturbance: {pose_delay_s: 0.04}\n")
    described = read_backend(str(file))
    assert (described.label, described.disturbance.pose_delay_s) == ("late", 0.04)
    assert isinstance(connect(described, WorldConfig()).poses, DisturbedPoses)
    own = read_backend("service.robot.mujoco_robot:connect")
    assert type(connect(own, WorldConfig()).robot).__name__ == "MujocoRobot"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (None, "unknown robot 'armm': name mujoco, pybullet, franka"),
        ("backend: mujoco\nparamters: {}\n", "unknown key 'paramters'"),
        ("backend: mujoco\ndisturbance: {pose_delay_s: -1}\n", r"disturbance.pose_delay_s = -1: .*greater than"),
        ("backend: mujoco\nparameters: {friction: high}\n", "robot mujoco: parameters: friction = 'high'"),
        ("backend: nowhere:at_all\n", "robot 'nowhere:at_all' cannot be made: .* No module named 'nowhere'"),
        ("backend: my_arm.py:connect\n", "write it as Python imports it, my_arm:connect"),
        ("backend: os:getcwd\n", "robot 'os:getcwd' cannot be made: TypeError: "),
        ("backend: operator:eq\n", "robot 'operator:eq' made bool; return a "),
    ],
)
def test_what_is_no_robot(text, match, tmp_path):
    reference = "armm"
    if text is not None:
        (tmp_path / "robot.yaml").write_text(text)
        reference = str(tmp_path / "robot.yaml")
    with pytest.raises(TandemError, match=match):
        connect(read_backend(reference), WorldConfig())
