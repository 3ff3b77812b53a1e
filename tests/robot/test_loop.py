import numpy as np

from service.config import WorldConfig
from service.envs.observations import layouts
from service.robot.disturbed import DisturbanceConfig, DisturbedPoses
from service.robot.loop import Bridge, BridgeConfig
from tests.robot.fakes import HOME_M, OBJECT_M, FakeRobot, Steady

GOAL_M = np.array([0.0, 0.1, 0.2])


class Counting:
    """Acts by the number of its step, in hundredths, and keeps what it saw."""

    def __init__(self):
        self.seen = []

    def begin(self):
        self.seen.clear()

    def act_deterministic(self, observation):
        self.seen.append(observation[0].copy())
        return np.full((1, 4), 0.01 * len(self.seen), dtype=np.float32)


def played(config, world=None, num_steps=5):
    robot, policy, rows = FakeRobot(), Counting(), []
    bridge = Bridge(policy, robot, robot.poses, world or WorldConfig(), config, record=rows.append)
    bridge.run(GOAL_M, num_steps)
    return robot, policy.seen, rows, bridge


def test_an_observation_has_the_layout_of_the_policys_world():
    world = WorldConfig(observed={"num_commands": 2})
    bob = layouts(world).bob
    _, seen, rows, _ = played(BridgeConfig(), world)
    first, third = seen[0], seen[2]
    assert third.shape == (bob.size,)
    np.testing.assert_allclose(first[bob["effector"]], HOME_M, atol=1e-6)
    np.testing.assert_allclose(third[bob["effector"]], rows[2]["effector_m"], atol=1e-6)
    np.testing.assert_allclose(third[bob["fingers"]], 0.04)
    np.testing.assert_allclose(third[bob["object"]], OBJECT_M, atol=1e-6)
    np.testing.assert_allclose(third[bob["object_from_effector"]], OBJECT_M - rows[2]["effector_m"], atol=1e-6)
    np.testing.assert_allclose(third[bob["goal"]], GOAL_M, atol=1e-6)
    np.testing.assert_allclose(first[bob["command_1"]], 0.0)
    np.testing.assert_allclose(third[bob["command_1"]], 0.02, atol=1e-6)  # the newest first
    np.testing.assert_allclose(third[bob["command_2"]], 0.01, atol=1e-6)


def test_where_the_object_is_seen_late_the_robot_is_shown_as_it_was_then():
    world = WorldConfig(observed={"num_commands": 2, "delay": True})
    bob = layouts(world).bob
    robot, policy, rows = FakeRobot(), Counting(), []
    poses = DisturbedPoses(robot.poses, robot.now_s, DisturbanceConfig(pose_delay_s=0.08))
    bridge = Bridge(policy, robot, poses, world, BridgeConfig(), record=rows.append)
    bridge.run(GOAL_M, 5)
    seen = policy.seen
    np.testing.assert_allclose([row[:3] for row in seen[2:]], [row["effector_m"] for row in rows[:3]], atol=1e-6)
    assert (seen[4][:3] != rows[4]["effector_m"]).any()
    np.testing.assert_allclose(seen[4][bob["command_1"]], 0.04, atol=1e-6)  # what it asked for is known at once
    np.testing.assert_allclose(seen[4][bob["command_2"]], 0.03, atol=1e-6)
    assert [row[bob["delay"]] for row in seen] == [[0.0], [1.0], [2.0], [2.0], [2.0]]
    poses.forget()
    bridge.run(GOAL_M, 1)  # a new episode remembers nothing of the one before
    np.testing.assert_allclose(policy.seen[0][:3], rows[5]["effector_m"], atol=1e-6)
    np.testing.assert_allclose(policy.seen[0][bob["command_1"]], 0.0)


def test_a_gripper_that_was_held_closed_in_training_stays_closed():
    robot, _, rows, _ = played(BridgeConfig(), WorldConfig(gripper="blocked"))
    assert rows[-1]["action"][3] > 0.0  # it asks to open
    assert {command.width_m for _, command in robot.commands[: 5 * 10]} == {0.0}


def test_steps_are_40_ms_and_end_at_rest():
    robot, _, rows, bridge = played(BridgeConfig(set_points_per_step=4), num_steps=3)
    np.testing.assert_allclose([row["time_s"] for row in rows], [0.0, 0.04, 0.08], atol=1e-9)
    np.testing.assert_allclose(rows[1]["tick_times_s"], [0.04, 0.05, 0.06, 0.07], atol=1e-9)
    assert bridge.safe.limiter.is_still
    assert len(robot.commands) > 12  # it braked


def test_what_is_held_stays_held_while_it_comes_to_rest():
    """Fingers that are sent to where they are press with nothing."""
    robot = FakeRobot()
    robot.fingers_m = np.array([0.025, 0.025])  # on an object, which keeps them apart
    Bridge(Steady([1.0, 0.0, 0.0, -1.0]), robot, robot.poses, WorldConfig(), BridgeConfig()).run(GOAL_M, 3)
    assert len(robot.commands) > 3 * 10  # it braked
    assert {command.width_m for _, command in robot.commands} == {0.0}


def test_it_comes_to_rest_however_slowly_it_may_brake():
    slow = BridgeConfig(set_points_per_step=4, safety={"max_acceleration_m_s2": 0.05})
    robot, policy = FakeRobot(), Steady([-1.0, 0.0, 0.0, 0.0])
    bridge = Bridge(policy, robot, robot.poses, WorldConfig(), slow)
    bridge.run(GOAL_M, 60)
    assert len(robot.commands) > 60 * 4 + 100  # braking took more than a second
    assert bridge.safe.limiter.is_still
