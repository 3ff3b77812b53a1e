"""The back-end of a Franka: against a fake of ``franky``, and against the library in its simulator."""

import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from service.base.errors import RobotError, TandemError
from service.config.world import WorldConfig
from service.envs import panda
from service.robot import franka_robot
from service.robot.backends import BackendConfig, connect
from service.robot.franka_robot import FrankaParameters, FrankaRobot, Hand
from service.robot.interface import Command, ObjectPose

PARAMETERS = FrankaParameters(host="robot.local")
TIP_IN_BASE = np.array([0.55, 0.02, 0.10])
MINE = WorldConfig.model_construct(robot=panda.PANDA.model_copy(update={"name": "my-arm"}))


class Affine:
    def __init__(self, translation, quaternion):
        assert np.shape(translation) == (3,)
        assert np.shape(quaternion) == (4,)
        self.translation, self.quaternion = np.asarray(translation), np.asarray(quaternion)


class Future:
    def __init__(self, ended):
        self.ended = ended

    def wait(self, timeout=None):
        return self.ended


class Gripper:
    """Records what it is told; a motion ends when the test says so."""

    def __init__(self):
        self.width, self.max_width, self.is_grasped, self.told, self.ends = 0.08, 0.08, False, [], True

    @property
    def state(self):
        return SimpleNamespace(width=self.width, is_grasped=self.is_grasped)

    def move_async(self, width, speed):
        self.told.append(("move", width))
        return Future(self.ends)

    def grasp_async(self, width, speed, force, epsilon_inner, epsilon_outer):
        self.told.append(("grasp", width, force))
        return Future(self.ends)

    def stop_async(self):
        self.told.append(("stop",))
        return Future(True)


class Franky:
    """As much of ``franky`` as the back-end uses."""

    Affine = Affine
    RealtimeConfig = SimpleNamespace(Enforce="enforce", Ignore="ignore")

    def __init__(self, quaternion=(1.0, 0.0, 0.0, 0.0)):
        self.targets, self.motions, self.gripper = [], [], Gripper()
        pose = Affine(TIP_IN_BASE, quaternion)
        self.robot = SimpleNamespace(
            has_errors=False,
            current_pose=SimpleNamespace(end_effector_pose=pose),
            set_collision_behavior=lambda torque, force: None,
            move=lambda motion, asynchronous: self.motions.append(motion),
            join_motion=lambda timeout: True,
        )
        self.tracker = SimpleNamespace(is_running=True, set_target=self.targets.append)

    def Robot(self, host, realtime_config):  # noqa: N802
        self.host, self.realtime = host, realtime_config
        return self.robot

    def Gripper(self, host):  # noqa: N802
        return self.gripper

    def CartesianImpedanceTracker(self, robot, **given):  # noqa: N802
        assert robot is self.robot
        self.given = given
        return self.tracker

    def TorqueStopMotion(self):  # noqa: N802
        return "stop motion"


@pytest.fixture
def franky():
    return Franky()


@pytest.fixture
def robot(franky):
    made = FrankaRobot(franky, PARAMETERS)
    yield made
    made.close()


def until(condition):
    end_s = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def test_what_it_says_is_in_the_frame_of_the_primitives(robot, franky):
    state = robot.read()
    np.testing.assert_allclose(state.effector_m, TIP_IN_BASE - [0.6, 0.0, 0.0])
    np.testing.assert_allclose(state.fingers_m, [0.04, 0.04])
    assert state.connected
    assert abs(state.time_s - time.monotonic()) < 5.0
    assert (franky.host, franky.realtime) == ("robot.local", "enforce")


def test_set_points_go_out_in_the_frame_of_the_arm_and_begin_its_control(robot, franky):
    assert not hasattr(franky, "given")
    robot.command(Command(np.array([-0.05, 0.1, 0.2]), 0.08))
    robot.command(Command(np.array([0.0, 0.0, 0.05]), 0.08))
    assert franky.given["translational_stiffness"] == PARAMETERS.translational_stiffness_n_m
    np.testing.assert_allclose([target.translation for target in franky.targets], [[0.55, 0.1, 0.2], [0.6, 0.0, 0.05]])
    np.testing.assert_array_equal(franky.targets[0].quaternion, [1.0, 0.0, 0.0, 0.0])  # x y z w: points down


def test_stop_ends_the_control_once_and_for_all(robot, franky):
    franky.gripper.ends = False
    robot.command(Command(np.zeros(3), 0.0))
    until(lambda: franky.gripper.told)
    robot.stop()
    robot.stop()
    until(lambda: franky.gripper.told[-1] == ("stop",))
    assert franky.motions == ["stop motion"]
    with pytest.raises(RobotError, match=r"franka at robot\.local: it was stopped"):
        robot.command(Command(np.zeros(3), 0.08))


def test_a_gripper_that_nearly_points_down_is_taken_however_its_quaternion_is_signed():
    FrankaRobot(Franky((-0.998, 0.05, 0.03, -0.02)), PARAMETERS).close()


def test_a_reflex_shows_as_no_longer_connected_and_an_error_as_one_line(robot, franky):
    robot.command(Command(np.zeros(3), 0.08))
    franky.tracker.is_running = False
    assert not robot.read().connected
    franky.tracker.is_running, franky.robot.has_errors = True, True
    assert not robot.read().connected
    del franky.robot.current_pose
    with pytest.raises(RobotError, match=r"^robot franka at robot\.local: read: AttributeError: [^\n]*$"):
        robot.read()


@pytest.mark.parametrize(
    ("errors", "quaternion", "message"),
    [
        (True, (1.0, 0.0, 0.0, 0.0), "unlock"),
        (False, (0.7071, 0.0, 0.0, 0.7071), "1.6 rad off pointing down"),
        (False, (0.7071, 0.7071, 0.0, 0.0), "1.6 rad off .* left finger on the side of negative y"),  # down, but turned
        (False, (0.0, 1.0, 0.0, 0.0), "3.1 rad off"),  # left is right
    ],
)
def test_a_robot_that_is_not_ready_is_refused_before_anything_moves(errors, quaternion, message):
    franky = Franky(quaternion)
    franky.robot.has_errors = errors
    with pytest.raises(RobotError, match=message):
        FrankaRobot(franky, PARAMETERS)
    assert not franky.motions


@pytest.fixture
def gripper():
    return Gripper()


@pytest.fixture
def hand(gripper):
    made = Hand(gripper, PARAMETERS)
    made.close()  # the test itself does what the thread does
    return made


def test_the_hand_grasps_to_close_moves_to_open_and_keeps_what_it_holds(hand, gripper):
    for width in (0.079, 0.05, 0.049):  # the first and the last are no change worth a motion
        hand.go_to(width, 20.0)
        hand.advance()
    assert gripper.told == [("grasp", 0.05, 20.0)]
    gripper.width, gripper.is_grasped = 0.05, True
    hand.go_to(0.0, 20.0)
    hand.advance()
    assert len(gripper.told) == 1
    assert hand.width_m == 0.05
    hand.go_to(0.07, 20.0)
    hand.advance()
    assert gripper.told[-1] == ("move", 0.07)


def test_the_hand_lets_go_only_for_a_width_greater_than_that_of_what_it_holds(hand, gripper):
    hand.go_to(0.0, 20.0)
    hand.advance()
    gripper.width, gripper.is_grasped = 0.05, True
    for width in (0.03, 0.05, 0.053, 0.06):
        hand.go_to(width, 20.0)
        hand.advance()
    assert gripper.told == [("grasp", 0.0, 20.0), ("move", 0.06)]


def test_the_hand_ends_a_motion_before_the_next_and_when_it_is_halted(hand, gripper):
    gripper.ends = False
    for width in (0.0, 0.08):
        hand.go_to(width, 20.0)
        hand.advance()
    assert gripper.told == [("grasp", 0.0, 20.0), ("stop",), ("move", 0.08)]
    hand.halt()
    hand.advance()
    hand.advance()
    assert gripper.told[3:] == [("stop",)]


def test_a_hand_that_does_not_end_its_motion_stops_the_robot(robot, franky, monkeypatch):
    monkeypatch.setattr(franka_robot, "_MOST_MOTION_S", 0.0)
    franky.gripper.ends = False
    robot.command(Command(np.zeros(3), 0.0))

    def fails():
        try:
            robot.read()
        except RobotError as error:
            return "hand: TimeoutError: a motion has not ended" in str(error)

    until(fails)


def test_a_hand_that_is_silent_for_longer_than_a_motion_takes_stops_the_robot(robot, monkeypatch):
    robot._hand.close()  # as if its thread hung in the library
    measured_s = robot._hand.time_s
    assert 0.0 <= robot.now_s() - measured_s < 5.0
    monkeypatch.setattr(robot, "now_s", lambda: measured_s + 0.9)
    assert robot.read().time_s == measured_s + 0.9
    monkeypatch.setattr(robot, "now_s", lambda: measured_s + 1.1)
    with pytest.raises(RobotError, match=r"franka at robot\.local: hand: no answer for 1\.1 s"):
        robot.read()


def test_the_arm_is_told_its_greatest_contact_forces_and_stiffness(franky):
    told = []
    franky.robot.set_collision_behavior = lambda torque, force: told.append((torque, force))
    robot = FrankaRobot(
        franky,
        FrankaParameters(
            host="h", max_contact_force_n=20.0, max_contact_torque_nm=10.0, rotational_stiffness_nm_rad=50.0
        ),
    )
    assert told == [(10.0, 20.0)]
    robot.command(Command(np.zeros(3), 0.08))
    robot.close()
    assert franky.given == {"translational_stiffness": 1500.0, "rotational_stiffness": 50.0}


def test_a_robot_that_was_stopped_before_its_first_command_takes_none(robot):
    robot.stop()
    with pytest.raises(RobotError, match="it was stopped"):
        robot.command(Command(np.zeros(3), 0.08))


def test_the_hand_has_its_speed_and_force_and_takes_an_object_of_any_width(gripper):
    told = []
    gripper.grasp_async = gripper.move_async = lambda *given: told.append(given)
    hand = Hand(gripper, FrankaParameters(host="h", hand_speed_m_s=0.05))
    hand.close()  # its thread; what it does is done here, one by one
    for width_m in (0.02, 0.07):
        hand.go_to(width_m, 20.0)
        hand._running = None
        hand.advance()
        hand._running = None
    assert told == [(0.02, 0.05, 20.0, 0.08, 0.08), (0.07, 0.05)]


class Camera:
    def __init__(self, place):
        self._place = place

    def read(self):
        return ObjectPose(1.0, np.array(self._place))

    def close(self):
        pass


def connected(world=None, **parameters):
    return connect(BackendConfig(backend="franka", parameters=parameters), world or WorldConfig())


def test_what_sees_the_object_is_named_by_the_user(monkeypatch, franky):
    monkeypatch.setitem(sys.modules, "franky", franky)
    monkeypatch.setitem(sys.modules, "lab", SimpleNamespace(Camera=Camera))
    backend = connected(host="a", poses="lab:Camera", pose_parameters={"place": [0.1, 0.2, 0.3]})
    np.testing.assert_array_equal(backend.poses.read().position_m, [0.1, 0.2, 0.3])
    backend.close()
    backend = connected(host="a")
    assert np.isnan(backend.poses.read().position_m).all()
    backend.close()
    with pytest.raises(TandemError, match=r"poses = 'lab:Camera' cannot be made: .*'lens'"):
        connected(host="a", poses="lab:Camera", pose_parameters={"lens": 1})


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({}, "parameters: host"),
        ({"host": "a", "ip": "b"}, "unknown key 'ip'"),
        ({"host": "a"}, r"pip install 'tandem-skills\[franka\]'"),
        ({"host": "a", "world": MINE}, "trained with the arm 'my-arm'"),
    ],
)
def test_what_cannot_be_connected_is_told_in_one_line(parameters, message, monkeypatch):
    monkeypatch.setitem(sys.modules, "franky", None)
    with pytest.raises(TandemError, match=message) as caught:
        connected(**parameters)
    assert "\n" not in str(caught.value)


def test_an_arm_in_the_librarys_simulator_goes_where_it_is_sent():
    franky = pytest.importorskip("franky", reason="needs franky: pip install 'tandem-skills[franka]'")
    simulators = pytest.importorskip("franky_sim", reason="needs franky's simulator: pip install franky-sim")
    from franky_sim.mujoco_simulator import MujocoSimulator

    with MujocoSimulator(enable_visualization=False) as simulator:
        arm = simulator.add_robot()
        with simulators.SimulationServer(simulator) as server:
            server.run_async()
            robot = FrankaRobot(franky, FrankaParameters(host=arm.hostname, realtime=False))
            start = robot.read()
            target = start.effector_m + np.array([0.03, 0.0, -0.02])
            end_s = robot.now_s() + 60.0  # a busy machine simulates slowly
            while np.linalg.norm(robot.read().effector_m - target) > 0.012 and robot.now_s() < end_s:
                robot.command(Command(target, float(start.fingers_m.sum())))
                robot.wait_until(robot.now_s() + 0.01)
            assert np.linalg.norm(robot.read().effector_m - target) < 0.012
            robot.stop()
            robot.close()
