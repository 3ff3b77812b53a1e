"""Whatever policy, robot and tracker do: set-points stay within their bounds, and every fault ends in a stop."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from service.base.errors import ConfigError, RobotError
from service.config import WorldConfig
from service.envs.panda import PANDA
from service.robot.calibrate import calibrate
from service.robot.disturbed import DisturbanceConfig, DisturbedPoses, DisturbedRobot
from service.robot.loop import Bridge, BridgeConfig
from service.robot.safety import SafeRobot, SafetyConfig
from tests.robot.fakes import HOME_M, OBJECT_M, FakeRobot, Steady

WORLD = WorldConfig()
CONFIG = BridgeConfig(set_points_per_step=5)
BOX = CONFIG.safety.box(WORLD)
FAULTS = {
    "read fails": "no answer",
    "command fails": "refused",
    "slow read": "late: reading took until",
    "stale state": "the robot's state is frozen",
    "lost joints": "the robot's state is not finite",
    "disconnected": "the robot takes no more commands",
    "late": "late: a step came",
    "frozen pose": "the object's pose is frozen",
    "ageing pose": "the object's newest pose is",
    "unseen": "the object is not seen",
    "jumping pose": "the pose of the object jumps",
    "no pose": "no pose was read",
    "early pose": "set the clocks alike",
    "switch": "the dead-man's switch was let go",
    "NaN": "the policy's action is not finite",
    "infinity": "the policy's action is not finite",
    "policy raises": "ZeroDivisionError",
    "policy is slow": "late",
    "interrupt": "KeyboardInterrupt",
}
ALLOWED_S = {"ageing pose": CONFIG.safety.watch.max_pose_age_s / 0.9}  # its age grows by 0.9 s in a second
"""What a measurement may be late by before that is a fault."""


class Adversary:
    """Random and extreme actions, each held for some steps; faults of its own."""

    def __init__(self, robot, rng):
        self.robot, self.rng, self.held, self.action = robot, rng, 0, np.zeros(4)

    def act_deterministic(self, observation):
        assert np.isfinite(observation).all()
        if self.held == 0:
            kind = self.rng.integers(3)
            extreme, small = self.rng.choice([-1.0, 1.0, 1e6, -1e6], 4), self.rng.uniform(-1.0, 1.0, 4)
            self.action, self.held = (extreme, small, np.zeros(4))[kind], self.rng.integers(1, 6)
        self.held -= 1
        if self.robot.has("policy raises"):
            return 1 / 0
        if self.robot.has("interrupt"):
            raise KeyboardInterrupt
        if self.robot.has("policy is slow"):
            self.robot.time_s += 0.06
        bad = {"NaN": np.nan, "infinity": np.inf}.get(self.robot.fault)
        action = self.action.astype(np.float32)
        if bad is not None and self.robot.has(self.robot.fault):
            action[self.rng.integers(4)] = bad
        return action[None]


def played(robot, rng, num_steps, **more):
    bridge = Bridge(
        Adversary(robot, rng), robot, robot.poses, WORLD, CONFIG, held=lambda: not robot.has("switch"), **more
    )
    bridge.run(np.array([0.0, 0.0, 0.2]), num_steps)
    return bridge


def check_commands(robot):
    """Every set-point inside the box, and its motion inside the bounds, from times and places alone."""
    start_s = robot.commands[0][0] - 0.04 / CONFIG.set_points_per_step  # it has been at rest
    times = np.array([start_s, *(time_s for time_s, _ in robot.commands)])
    places = np.array([HOME_M, *(command.effector_m for _, command in robot.commands)])
    widths = np.array([command.width_m for _, command in robot.commands])
    assert ((places >= BOX.lower_m) & (places <= BOX.upper_m)).all()
    assert places[:, 2].min() >= 0.012
    assert ((widths >= 0.0) & (widths <= 0.08)).all()
    gaps = np.diff(times)
    assert (np.diff(places, axis=0)[gaps == 0] == 0).all()
    kept = np.concatenate([[True], gaps > 0])
    velocity = np.diff(places[kept], axis=0) / np.diff(times[kept])[:, None]
    velocity = np.concatenate([np.zeros((1, 3)), velocity])  # it starts at rest
    assert np.linalg.norm(velocity, axis=1).max() <= 1.7 * (1 + 1e-9)
    change = np.diff(velocity, axis=0) / np.diff(times[kept])[:, None]
    assert np.linalg.norm(change, axis=1).max(initial=0.0) <= 13.0 * (1 + 1e-6)
    return len(robot.commands)


def test_ten_thousand_commands_through_the_loop_stay_within_their_bounds():
    num, seed = 0, 0
    while num < 10_000:
        rng = np.random.default_rng(seed)
        robot = FakeRobot(lag_s=rng.choice([0.0, 0.02, 0.05]), jitter_s=rng.choice([0.0, 0.003, 0.02]), rng=rng)
        played(robot, rng, 60)
        num, seed = num + check_commands(robot), seed + 1
        assert not robot.stops
        assert np.linalg.norm(robot.commands[-1][1].effector_m - robot.commands[-2][1].effector_m) < 0.006  # it brakes


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_ends_in_a_stop_within_100_ms(fault):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        robot = FakeRobot(lag_s=0.02, jitter_s=0.003, rng=rng)
        robot.fault, robot.fault_s = fault, rng.uniform(0.0, 1.0)
        rows = []
        with pytest.raises((RobotError, ZeroDivisionError, KeyboardInterrupt)):
            played(robot, rng, 60, record=rows.append)
        assert robot.stops
        assert robot.stops[0] - robot.fault_s <= 0.1 + ALLOWED_S.get(fault, 0.0)
        assert FAULTS[fault] in rows[-1]["stopped"]
        assert all(time_s <= robot.stops[0] for time_s, _ in robot.commands)
        if robot.commands:
            check_commands(robot)


def test_a_policy_that_hangs_is_noticed_from_outside():
    robot = FakeRobot()

    class Hanging:
        def act_deterministic(self, observation):
            robot.time_s += 0.08  # by the robot's clock; nobody comes back to look at it
            assert robot.stopped.wait(30.0)
            return np.ones((1, 4), dtype=np.float32)

    bridge = Bridge(Hanging(), robot, robot.poses, WORLD, CONFIG)
    with pytest.raises(RobotError, match="the control loop hangs, for 80 ms"):
        bridge.run(OBJECT_M, 5)
    assert robot.commands == []  # nor does it move when the policy comes back


def test_a_dry_run_commands_nothing_and_stops_nothing():
    robot, rows = FakeRobot(), []
    played(robot, np.random.default_rng(0), 5, dry_run=True, record=rows.append)
    assert robot.commands == robot.stops == []
    assert len(rows) == 5
    assert {"action", "target_m", "width_m"} <= rows[0].keys()
    robot.effector_m = robot.set_point_m = np.array([-0.05, 0.0, 0.0])  # a person has put the tip on the table
    played(robot, np.random.default_rng(0), 1, dry_run=True)
    assert robot.commands == robot.stops == []


def test_what_is_wrong_before_the_start_moves_nothing():
    def refused(robot, match):
        with pytest.raises(RobotError, match=match):
            played(robot, np.random.default_rng(0), 5)
        assert robot.commands == []

    outside = FakeRobot()
    outside.effector_m = np.array([-0.05, 0.0, 0.6])
    refused(outside, r"starts at \(-0.050, 0.000, 0.600\) m, outside the box x -0.275 to 0.175")
    refused(FakeRobot(read_s=0.009), "it answers late: reading takes 9.0 ms, and a set-point is due every 8.0 ms")
    for fault, match in (("slow read", "late: reading took"), ("unseen", "not seen"), ("switch", "switch was let go")):
        robot = FakeRobot()
        robot.fault, robot.fault_s = fault, 0.0
        refused(robot, match)


def test_a_jump_is_passed_over_and_the_pose_before_it_stands_in():
    robot = FakeRobot()
    safe = SafeRobot(robot, robot.poses, CONFIG.safety, WORLD)
    safe.start(0.004)
    robot.fault, robot.fault_s = "jumping pose", robot.time_s
    for _ in range(3):
        robot.advance(0.02)
        safe.measure(robot.time_s)
        np.testing.assert_array_equal(safe.object.position_m, OBJECT_M)
    robot.fault = ""
    robot.poses.position_m = OBJECT_M + np.array([0.0, 0.04, 0.0])  # a step that a hand or a gripper can make
    robot.advance(0.02)
    safe.measure(robot.time_s)
    np.testing.assert_array_equal(safe.object.position_m, robot.poses.position_m)


def test_measurements_two_steps_late_are_not_taken_for_frozen_ones_at_any_time_of_the_clock():
    late = DisturbanceConfig(state_delay_s=0.08, pose_delay_s=0.08)
    for start_s in (0.0, 2.07, 123.456):
        robot = FakeRobot()
        robot.time_s = start_s
        disturbed, poses = DisturbedRobot(robot, late), DisturbedPoses(robot.poses, robot.now_s, late)
        Bridge(Steady([0.1, 0.0, 0.0, 0.0]), disturbed, poses, WORLD, CONFIG).run(OBJECT_M, 4)
        assert not robot.stops


@pytest.mark.parametrize("late", [{"pose_delay_s": 0.12}, {"state_delay_s": 0.09}])
def test_what_is_later_than_a_time_stamp_may_stay_the_same_is_not_taken_for_frozen(late):
    """But no later than a measurement may be."""
    robot, config = FakeRobot(), DisturbanceConfig(**late)
    disturbed, poses = DisturbedRobot(robot, config), DisturbedPoses(robot.poses, robot.now_s, config)
    Bridge(Steady([0.1, 0.0, 0.0, 0.0]), disturbed, poses, WORLD, CONFIG).run(OBJECT_M, 6)
    assert not robot.stops


def test_an_arm_that_does_not_follow_is_stopped():
    robot, config = FakeRobot(lag_s=1e9), BridgeConfig(safety={"max_tracking_error_m": 0.02})
    with pytest.raises(RobotError, match="m from where it was sent"):
        Bridge(Steady([1.0, 0.0, 0.0, 0.0]), robot, robot.poses, WORLD, config).run(OBJECT_M, 50)


def test_an_action_means_a_way_from_where_the_gripper_is_measured():
    robot, rows = FakeRobot(), []
    config = BridgeConfig(pace=0.5, safety=SafetyConfig(max_speed_m_s=1e3, max_acceleration_m_s2=1e6))
    policy = Steady([0.4, -2.0, 0.0, -0.2])
    bridge = Bridge(policy, robot, robot.poses, WORLD, config, gain=(0.5, 1.0, 1.0), record=rows.append)
    bridge.run(OBJECT_M, 1)
    way = np.array([0.25 * 0.4 * 0.05, -0.5 * 0.05, 0.0])  # at half the pace; y is clipped to -1
    np.testing.assert_allclose(rows[0]["target_m"], HOME_M + way)
    assert rows[0]["width_m"] == pytest.approx(0.08 - 0.02)
    np.testing.assert_allclose(rows[0]["set_points_m"][-1], rows[0]["target_m"], atol=1e-3)
    path = np.array(rows[0]["set_points_m"])[:, 1]
    np.testing.assert_allclose(np.diff(path), -0.0025, rtol=1e-3)  # spread evenly over the step


def test_least_height_and_opening_are_those_of_the_policys_robot():
    other = PANDA.model_copy(update={"lowest_m": 0.03, "opening_m": 0.108})
    policy = Steady([0.0, 0.0, -1.0, 1.0])
    for safety, lowest_m, widest_m in (
        ({}, 0.03, 0.108),
        ({"lowest_m": 0.02, "max_width_m": 0.05}, 0.02, 0.05),
    ):
        robot = FakeRobot()
        world = WORLD.model_copy(update={"robot": other})
        Bridge(policy, robot, robot.poses, world, BridgeConfig(safety=safety)).run(OBJECT_M, 20)
        assert min(command.effector_m[2] for _, command in robot.commands) == pytest.approx(lowest_m)
        assert {command.width_m for _, command in robot.commands} == {widest_m}


@pytest.mark.parametrize("wrong", [{"lowest_m": 0.45}, {"lower_m": (0.1, 0.0, 0.0), "upper_m": (0.0, 0.1, 0.1)}])
def test_a_box_with_nothing_in_it(wrong):
    with pytest.raises(ConfigError, match=r"the box x .* is empty"):
        SafetyConfig(**wrong).box(WORLD)


def test_a_gripper_that_may_not_open_as_far_as_it_has_to():
    with pytest.raises(
        ConfigError, match=r"safety.min_width_m = 0.05: the gripper may open by 0.02 m at most; give less"
    ):
        SafeRobot(FakeRobot(), None, SafetyConfig(min_width_m=0.05, max_width_m=0.02), WorldConfig())


def test_what_a_back_end_writes_into_later_is_not_what_was_measured():
    robot = FakeRobot()
    read, own = robot.read, np.zeros(3)

    def in_place():
        state = read()
        own[:] = state.effector_m
        return replace(state, effector_m=own)

    robot.read, rows = in_place, []
    Bridge(Steady(np.ones(4)), robot, robot.poses, WORLD, CONFIG, record=rows.append).run(OBJECT_M, 4)
    assert np.ptp([row["effector_m"][0] for row in rows]) > 0.01


def test_a_command_has_its_greatest_force_and_least_opening():
    robot = FakeRobot()
    config = BridgeConfig(safety={"max_grip_force_n": 12.0, "min_width_m": 0.03})
    Bridge(Steady([0.0, 0.0, 0.0, -1.0]), robot, robot.poses, WORLD, config).run(OBJECT_M, 2)
    assert {command.grip_force_n for _, command in robot.commands} == {12.0}
    assert {command.width_m for _, command in robot.commands} == {0.03}


def test_a_command_that_overtakes_a_stop_is_followed_by_another_stop():
    robot = FakeRobot()
    safe = SafeRobot(robot, robot.poses, SafetyConfig(), WORLD)
    safe.start(0.004)
    command = robot.command

    def late(sent):
        safe.stop("by the other thread")
        command(sent)

    robot.command = late
    robot.advance(0.004)
    with pytest.raises(RobotError, match="stopped: by the other thread"):
        safe.move(HOME_M, 0.08, 0.04)
    assert len(robot.stops) == 2


def test_a_clock_that_cannot_be_read_by_the_watch_is_a_fault():
    robot = FakeRobot()
    safe = SafeRobot(robot, robot.poses, SafetyConfig(), WORLD)

    def now_s():
        if threading.current_thread().name == "robot-watch":
            raise OSError("gone")
        return robot.time_s

    robot.now_s = now_s
    with safe.guarded():
        assert robot.stopped.wait(60.0)
    assert safe.stopped == "the robot's clock cannot be read: gone"


def test_a_late_state_stops_the_robot():
    robot = FakeRobot()
    late = DisturbedRobot(robot, DisturbanceConfig(state_delay_s=0.12))
    with pytest.raises(RobotError, match="state is 120 ms old"):
        Bridge(Steady([0.1, 0.0, 0.0, 0.0]), late, robot.poses, WORLD, BridgeConfig()).run(OBJECT_M, 4)


def test_an_arm_that_is_too_slow_is_not_calibrated():
    config = BridgeConfig(safety={"max_tracking_error_m": 1.0})
    with pytest.raises(RobotError, match=r"it covers 7%, 7%, 7% .*can be matched"):
        calibrate("slow", FakeRobot(lag_s=0.5), WORLD, config)
