"""The back-end in PyBullet, with the real engine: frames and units, motion, grip, the same again, and bad input."""

import sys

import numpy as np
import pytest

from service.base.errors import ConfigError, RobotError, TandemError
from service.config.world import WorldConfig
from service.robot.backends import BackendConfig, ExactPoses, connect
from service.robot.interface import Command
from service.robot.pybullet_robot import CONTROL_STEP_S, PyBulletParameters, PyBulletRobot, lag_s, world_of

_NEEDS = "needs PyBullet: pip install 'tandem-skills[pybullet]'"
PLACE = np.array([0.05, 0.08, 0.02])


def make(**parameters):
    pytest.importorskip("pybullet", reason=_NEEDS)
    return PyBulletRobot(WorldConfig(), PyBulletParameters(**parameters))


@pytest.fixture(scope="module")
def robot():
    made = make()
    yield made
    made.close()


def go(robot, target, width, num_steps=25):
    for _ in range(num_steps):
        robot.command(Command(np.array(target), width, 70.0))
        robot.wait_until(robot.now_s() + CONTROL_STEP_S)


def test_it_starts_as_our_worlds_do_in_our_frame(robot):
    robot.reset(PLACE)
    state, workspace = robot.read(), robot.world.workspace
    np.testing.assert_allclose(state.effector_m, [workspace.center_x_m, workspace.center_y_m, 0.08], atol=1e-3)
    np.testing.assert_allclose(state.fingers_m, [0.04, 0.04], atol=1e-4)
    np.testing.assert_allclose(ExactPoses(robot, robot).read().position_m, PLACE, atol=1e-6)
    # Places and orientations of the links' own frames: the base, the hand, both fingers, the grasp target.
    base, hand, left, right, grasp = (
        robot._bullet.getLinkState(robot._robot, link, computeForwardKinematics=True)[4:6] for link in (0, 8, 9, 10, 11)
    )
    # The left finger is on the side of negative y, and the gripper points down.
    assert left[0][1] < -0.03 < 0.03 < right[0][1]
    down = np.reshape(robot._bullet.getMatrixFromQuaternion(hand[1]), (3, 3))
    np.testing.assert_allclose(down, np.diag([1.0, -1.0, -1.0]), atol=5e-3)
    # The base is 0.6 m behind the origin, and the tip is 1.6 mm above the URDF's own grasp target.
    assert base[0][0] == pytest.approx(-0.6, abs=1e-6)
    assert state.effector_m[2] - grasp[0][2] == pytest.approx(0.0016, abs=1e-5)


def test_its_cube_starts_on_the_table_whatever_the_policys_is(robot):
    robot.reset(np.array([0.05, 0.08, 0.025]))  # panda-gym's cube lies at 0.02
    np.testing.assert_allclose(robot.object_position(), PLACE, atol=1e-6)


def test_it_goes_where_it_is_sent_in_metres_and_seconds(robot):
    robot.reset(PLACE)
    begin_s = robot.now_s()
    for target in ([-0.15, 0.1, 0.05], [0.05, -0.12, 0.3]):
        go(robot, target, 0.05, num_steps=60)
        np.testing.assert_allclose(robot.read().effector_m, target, atol=4e-3)
    assert robot.read().fingers_m.sum() == pytest.approx(0.05, abs=2e-3)
    assert robot.now_s() - begin_s == pytest.approx(120 * CONTROL_STEP_S)


@pytest.mark.parametrize("share", [0.4, 0.7, 1.0])
def test_a_response_is_the_share_of_the_way_after_a_step(share):
    robot = make(response=share)
    for axis, way in ((0, 0.05), (1, -0.05), (2, 0.05)):
        robot.reset(PLACE)
        start = robot.read().effector_m
        robot.command(Command(start + way * np.eye(3)[axis], 0.08))
        robot.wait_until(robot.now_s() + CONTROL_STEP_S)
        assert (robot.read().effector_m - start)[axis] / way == pytest.approx(share, abs=0.03)
    robot.close()


def test_two_lags_in_series_go_the_asked_share():
    slow, fast, time_s = lag_s(0.55), 0.007, 0.04
    gone = 1.0 - (slow * np.exp(-time_s / slow) - fast * np.exp(-time_s / fast)) / (slow - fast)
    assert gone == pytest.approx(0.55, abs=1e-6)


def test_it_grips_and_lifts_the_heavy_cube(robot):
    robot.reset(PLACE)
    above = [*PLACE[:2], 0.09]
    go(robot, above, 0.08)
    go(robot, [*PLACE[:2], 0.015], 0.08)
    go(robot, [*PLACE[:2], 0.015], 0.0, num_steps=15)
    assert robot.read().fingers_m.sum() == pytest.approx(0.04, abs=3e-3)
    for height in np.linspace(0.015, 0.25, 25):
        go(robot, [*PLACE[:2], height], 0.0, num_steps=2)
    go(robot, [*PLACE[:2], 0.25], 0.0)
    lifted = robot.object_position()
    assert lifted[2] > 0.23
    assert np.linalg.norm(lifted - robot.read().effector_m) < 0.02
    robot.stop()
    robot.wait_until(robot.now_s() + 1.0)
    np.testing.assert_allclose(robot.object_position(), lifted, atol=5e-3)  # stopped, it holds
    with pytest.raises(RobotError, match="was stopped"):
        robot.command(Command(np.array(above), 0.08))
    robot.reset(PLACE)
    go(robot, above, 0.08, num_steps=1)


def test_an_episode_does_not_depend_on_those_before_it_or_on_the_engine(robot):
    other = make()

    def episode(played):
        played.reset(PLACE)
        begin_s = played.now_s()
        path = []
        for step in range(20):
            played.command(Command(np.array([*PLACE[:2], 0.07 - 0.004 * step]), 0.08 - 0.004 * step))
            played.wait_until(begin_s + (step + 1) * CONTROL_STEP_S)
            path.append([*played.read().effector_m, *played.object_position()])
        return np.array(path)

    first = episode(other)
    go(robot, [0.1, 0.1, 0.2], 0.0)
    np.testing.assert_array_equal(episode(robot), first)
    other.close()


def test_the_wall_stands_where_that_of_the_task_does():
    pytest.importorskip("pybullet", reason=_NEEDS)
    robot = PyBulletRobot(WorldConfig(fixture="wall", start_height_m=0.12))
    x = robot.world.workspace.center_x_m

    def hit(height):
        return robot._bullet.rayTest((x + 0.1, 0.1, height), (x - 0.1, 0.1, height))[0]

    assert hit(0.069)[3][0] == pytest.approx(x + 0.005, abs=1e-6)
    assert hit(0.072)[0] == -1
    robot.close()


def test_numbers_are_those_of_panda_gym(robot):
    pytest.importorskip("panda_gym", reason="needs panda-gym: pip install 'tandem-skills[bench]'")
    from panda_gym.envs.robots.panda import Panda
    from panda_gym.envs.tasks.pick_and_place import PickAndPlace
    from panda_gym.pybullet import PyBullet

    sim = PyBullet()
    theirs = Panda(sim, base_position=np.array([-0.6, 0.0, 0.0]))
    PickAndPlace(sim)

    def dynamics(bullet, body, link):
        return bullet.getDynamicsInfo(body, link)[:8]

    for link in (9, 10, 8, -1):
        assert dynamics(robot._bullet, robot._robot, link) == dynamics(sim.physics_client, 0, link)
    cube = sim._bodies_idx["object"]
    assert dynamics(robot._bullet, robot._object, -1) == dynamics(sim.physics_client, cube, -1)
    table = sim._bodies_idx["table"]
    np.testing.assert_allclose(robot._bullet.getAABB(1), sim.physics_client.getAABB(table), atol=1e-6)
    assert robot._bullet.getDynamicsInfo(1, -1)[1] == sim.physics_client.getDynamicsInfo(table, -1)[1]
    assert tuple(robot._forces) == tuple(theirs.joint_forces[:7])
    sim.close()


@pytest.mark.parametrize(
    "world",
    [
        {"object": "sphere"},
        {"fixture": "box"},
        {"obstacles": ({"shape": "box", "size_m": (0.06, 0.06, 0.06)},)},
    ],
)
def test_worlds_that_it_cannot_show_are_refused(world):
    (key,) = world
    with pytest.raises(ConfigError, match=f"world.{key}.*PyBullet has"):
        world_of(WorldConfig(**world), PyBulletParameters(cube="world"))


@pytest.mark.parametrize(
    ("parameters", "message"),
    [({"gain": 1}, "unknown key 'gain'"), ({"response": 2.0}, "response = 2.0"), ({}, r"tandem-skills\[pybullet\]")],
)
def test_what_cannot_be_made_is_told_in_one_line(parameters, message, monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(TandemError, match=message) as caught:
        connect(BackendConfig(backend="pybullet", parameters=parameters), WorldConfig())
    assert "\n" not in str(caught.value)
