import numpy as np
import pytest

from service.base.errors import RobotError, TandemError
from service.config import WorldConfig
from service.config.robot import read_robot
from service.envs.batch import WorldBatch
from service.registry.bundled import BUNDLED
from service.registry.loading import load
from service.robot.backends import ExactPoses
from service.robot.calibrate import Calibration, read_calibration, write_calibration
from service.robot.interface import Command
from service.robot.loop import Bridge, BridgeConfig
from service.robot.mujoco_robot import MujocoParameters, MujocoRobot, connect
from tests.envs.robots import GANTRY, GANTRY_DESCRIPTION, write_robot

JUMPS = BridgeConfig(
    pace=1.0,
    set_points_per_step=1,
    safety={"max_speed_m_s": 1e6, "max_acceleration_m_s2": 1e6, "max_tracking_error_m": 1.0, "margin_m": 0.3},
)
WORLD = WorldConfig(physics_step_s=0.005, num_substeps=8)
SMOOTH = BridgeConfig(set_points_per_step=8, pace=1.0)


def test_without_bounds_the_bridge_plays_what_the_evaluator_plays(champion):
    """The same observations and actions to the tenth of a millimetre, until contacts make more of it."""
    world, goal = champion.config.world, np.array([[-0.1, 0.05, 0.2]])
    with WorldBatch(world, 1) as worlds:
        worlds.reset(np.random.default_rng(4))
        robot = MujocoRobot(world)
        robot.reset(worlds.object_position[0])
        rows, paths = [], []
        Bridge(champion.policy, robot, ExactPoses(robot, robot), world, JUMPS, record=rows.append).run(goal[0], 50)
        for _ in range(50):
            paths.append(worlds.ee_position[0].copy())
            worlds.step(champion.policy.act_deterministic(np.hstack([worlds.positions(), goal]).astype(np.float32)))
        near = np.linalg.norm(worlds.object_position[0] - goal[0])
    np.testing.assert_allclose([row["effector_m"] for row in rows[:6]], paths[:6], atol=1e-4)
    assert near < 0.05
    assert np.linalg.norm(robot.object_position() - goal[0]) < 0.05


def test_two_cubes_are_played_as_the_evaluator_plays_them():
    """The observations and actions of both, in a place each; and a log of it shows them where they were."""
    policy = load("panda-two-cubes@champion", BUNDLED)
    world, goal = policy.world, np.array([[-0.1, 0.05, 0.2, 0.05, -0.1, 0.025]])
    with WorldBatch(world, 1) as worlds:
        worlds.reset(np.random.default_rng(5))
        start = worlds.object_position[0].copy()
        robot = connect(world, {}).robot
        robot.reset(start)
        np.testing.assert_allclose(robot.object_position(), start, atol=1e-9)
        rows, paths = [], []
        away = Bridge(policy.policy, robot, ExactPoses(robot, robot), world, JUMPS, record=rows.append).run(goal[0], 5)
        for _ in range(5):
            paths.append(worlds.ee_position[0].copy())
            worlds.step(policy.policy.act_deterministic(np.hstack([worlds.positions(), goal]).astype(np.float32)))
    np.testing.assert_allclose([row["effector_m"] for row in rows[:4]], paths[:4], atol=1e-4)  # then it touches
    last = robot.object_position().reshape(2, 3)
    assert away == pytest.approx(np.linalg.norm(last - goal.reshape(2, 3), axis=1).max(), abs=0.01)


def test_the_champion_reaches_goals_within_the_bounds_of_a_franka(champion):
    """As recorded, 97 % and more of goals: none of these may be missed. The tip stays in the box of set-points."""
    world, rows = champion.config.world, []
    robot = MujocoRobot(world, MujocoParameters(feed_forward=1.0))
    bridge = Bridge(
        champion.policy, robot, ExactPoses(robot, robot), world, SMOOTH, gain=(0.62, 0.62, 0.62), record=rows.append
    )
    goals = np.array([[-0.1, 0.05, 0.2], [0.05, -0.1, 0.025], [-0.15, -0.1, 0.1]])
    for goal in goals:
        robot.reset(np.array([0.0, 0.05, 0.025]))
        assert bridge.run(goal, 50) < 0.05
    assert robot.now_s() >= 2.0
    tip, box = np.concatenate([row["measured_m"] for row in rows]), SMOOTH.safety.box(world)
    assert ((tip > box.lower_m - 0.01) & (tip < box.upper_m + 0.01)).all()
    assert tip[:, 2].min() < 0.03  # it went down to the object


def test_a_set_point_before_the_physics_made_a_step_keeps_its_lead():
    """Of 4 ms ticks and 5 ms physics one in five comes at the time of the one before."""
    world = WorldConfig(physics_step_s=0.005, num_substeps=8)
    robot, sent = MujocoRobot(world, MujocoParameters(feed_forward=1.0)), []
    here, begun_s = robot.read().effector_m, robot.now_s()
    for tick in range(1, 16):
        robot.command(Command(here + 0.001 * tick * np.array([0.0, 1.0, 0.0]), 0.0))
        sent.append((robot.now_s(), robot._data.ctrl[0]))
        robot.wait_until(begun_s + 0.004 * tick)
    times, joints = np.array(sent[5:]).T
    assert (np.diff(times) == 0.0).any()
    assert np.ptp(np.diff(joints)) < 0.01


CALIBRATION = Calibration(
    robot="mine",
    arm="panda",
    step_s=0.04,
    set_points_per_step=8,
    max_speed_m_s=1.7,
    max_acceleration_m_s2=11.0,
    covered_share=(1.0, 0.8, 0.4),
    training_share=(0.6, 0.6, 0.6),
    delay_steps=0.5,
)


def test_a_calibration_shortens_ways_and_lengthens_none(champion, tmp_path):
    write_calibration(tmp_path / "mine.yaml", CALIBRATION)
    found = read_calibration(tmp_path / "mine.yaml")
    assert found == CALIBRATION
    assert found.gain == pytest.approx((0.6, 0.75, 1.0))
    found.check("mine", champion.config.world, SMOOTH)
    with pytest.raises(TandemError, match="measured with robot 'mine', not 'other'"):
        found.check("other", champion.config.world, SMOOTH)
    with pytest.raises(TandemError, match="set_points_per_step 8, not 10"):
        found.check("mine", champion.config.world, BridgeConfig())
    text = (tmp_path / "mine.yaml").read_text()
    (tmp_path / "bad.yaml").write_text(text.replace("- 0.4\n", "- 0.0\n"))
    with pytest.raises(TandemError, match=r"bad\.yaml: covered_share\.2 = 0\.0"):
        read_calibration(tmp_path / "bad.yaml")


def test_a_stopped_arm_holds_and_refuses():
    robot = MujocoRobot(WORLD)
    robot.command(Command(np.array([0.1, 0.1, 0.2]), 0.08))
    robot.wait_until(0.04)
    robot.stop()
    robot._data.ctrl[:7] += 0.5  # a command of the other thread, which was under way
    robot.stop()
    robot.wait_until(0.3)
    before = robot.read().effector_m
    robot.wait_until(0.6)
    np.testing.assert_allclose(robot.read().effector_m, before, atol=1e-4)
    with pytest.raises(RobotError, match="takes no commands until its next start"):
        robot.command(Command(np.zeros(3), 0.0))
    robot.reset(np.array([0.0, 0.0, 0.025]))
    assert robot.now_s() == pytest.approx(0.6)
    robot.command(Command(robot.read().effector_m, 0.0))


def test_its_object_starts_on_the_table_beside_the_gripper():
    """Whatever size it has here, and before the first start, too."""
    robot = MujocoRobot(WORLD, MujocoParameters(object_size_m=0.07))
    robot.reset(np.array([0.0, 0.1, 0.025]))
    np.testing.assert_allclose(robot.object_position(), [0.0, 0.1, 0.035])
    tall = WORLD.model_validate(WORLD.model_dump() | {"object": {"shape": "box", "size_m": (0.05, 0.05, 0.15)}})
    robot = MujocoRobot(tall)
    before = robot.object_position(), robot.read().effector_m
    robot.wait_until(0.4)
    np.testing.assert_allclose(robot.object_position(), before[0], atol=1e-3)
    np.testing.assert_allclose(robot.read().effector_m, before[1], atol=1e-3)


def test_parameters_change_the_arm_and_the_grip():
    robot = MujocoRobot(WORLD, MujocoParameters(stiffness_scale=2.0, object_mass_kg=0.5, joint_friction_nm=1.0))
    usual = MujocoRobot(WORLD)
    assert robot.model.actuator_gainprm[0, 0] == 2 * usual.model.actuator_gainprm[0, 0]
    assert robot.model.body("object").mass[0] == pytest.approx(0.5)
    assert robot.model.dof_frictionloss[0] == usual.model.dof_frictionloss[0] + 1.0
    robot.command(Command(robot.read().effector_m, 0.0, grip_force_n=10.0))
    assert np.abs(robot.model.actuator_forcerange[7:9]).max() == 10.0


def test_a_grip_force_does_not_bound_the_torque_of_fingers_that_turn(tmp_path):
    turning = read_robot(write_robot(tmp_path, GANTRY, GANTRY_DESCRIPTION, finger_max_force=6.0))
    robot = MujocoRobot(WORLD.model_copy(update={"robot": turning}))
    robot.command(Command(robot.read().effector_m, 0.0, grip_force_n=2.0))
    np.testing.assert_array_equal(robot.model.actuator_forcerange[3:5], [[-6.0, 6.0]] * 2)


@pytest.mark.parametrize(
    ("world", "parameters", "match"),
    [
        ({"fixture": "box"}, {}, "the box is elsewhere"),
        ({"obstacles": ({"shape": "box", "size_m": (0.06, 0.06, 0.06)},)}, {}, "obstacles are elsewhere"),
        ({"object": {"shape": "cylinder", "size_m": (0.05, 0.06)}}, {"object_size_m": 0.04}, "have theirs"),
    ],
)
def test_what_it_cannot_show_is_refused_before_anything_moves(world, parameters, match):
    with pytest.raises(TandemError, match=f"^robot mujoco: .*{match}"):
        connect(WorldConfig(**world), parameters)
