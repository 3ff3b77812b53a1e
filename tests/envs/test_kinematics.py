"""Kinematics against a matrix product written from the Panda's DH table, MuJoCo's own, and finite differences."""

import mujoco
import numpy as np
import pytest

from service.config import WorkspaceConfig, WorldConfig
from service.envs.batch import DISPLACEMENT_M
from service.envs.kinematics import Chain
from service.envs.panda import JOINT_LOWER, JOINT_UPPER, PANDA
from service.envs.reach import reach_of
from service.envs.robot import Robot
from service.envs.sampling import sample_in_volume
from service.envs.scene import build_spec
from tests.envs.arms import random_arm

# Franka's table, as angles: a, d, alpha of each joint, modified DH.
DH = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -np.pi / 2),
    (0.0, 0.316, np.pi / 2),
    (0.0825, 0.0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0.0, 0.0, np.pi / 2),
    (0.088, 0.0, np.pi / 2),
)
TIP_M = 0.2104
KINDS = [("hinge",) * 7, ("hinge",) * 6, ("hinge",) * 5, ("slide", "hinge", "hinge", "slide", "hinge"), ("slide",) * 3]


@pytest.fixture(scope="module")
def model():
    return build_spec(WorldConfig()).compile()


@pytest.fixture(scope="module")
def arm(model):
    """The Panda's."""
    return Robot(WorldConfig(), model).arm


@pytest.fixture
def joints():
    return np.random.default_rng(0).uniform(JOINT_LOWER, JOINT_UPPER, (200, 7))


def chain_of(kinds, seed):
    """A random arm, and its chain to something that is fixed to its last link."""
    model, names = random_arm(kinds, seed)
    place = {"position": (0.1, -0.05, 0.2), "quaternion": (0.5, 0.1, -0.7, 0.3)}
    return model, Chain(model, names, "tip", **place, home=[0.0] * len(names), orientation="down")


def dh_product(angles):
    """(4, 4) pose of the end effector of one Panda, one matrix per joint (Craig 2005, eq. 3.6)."""
    pose = np.eye(4)
    pose[:3, 3] = (-0.6, 0.0, 0.0)
    for angle, (a, d, alpha) in zip(angles, DH, strict=True):
        ct, st, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        pose = pose @ np.array(
            [
                [ct, -st, 0.0, a],
                [st * ca, ct * ca, -sa, -sa * d],
                [st * sa, ct * sa, ca, ca * d],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    half = np.sqrt(0.5)
    flange_to_tip = np.eye(4)
    flange_to_tip[:3, :3] = [[half, half, 0.0], [-half, half, 0.0], [0.0, 0.0, 1.0]]  # the hand is turned by 45 degrees
    flange_to_tip[2, 3] = TIP_M
    return pose @ flange_to_tip


def test_the_pandas_forward_is_the_dh_product(arm, joints):
    found = arm.forward(joints)
    expected = np.stack([dh_product(angles) for angles in joints])
    np.testing.assert_allclose(found.position, expected[:, :3, 3], rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.rotation, expected[:, :3, :3], rtol=0, atol=1e-7)


@pytest.mark.parametrize("kinds", KINDS, ids=lambda kinds: "".join(kind[0] for kind in kinds))
def test_any_chain_is_mujocos(kinds):
    model, chain = chain_of(kinds, seed=len(kinds))
    data, names = mujoco.MjData(model), [model.joint(index).name for index in range(model.njnt)]
    joints = np.random.default_rng(1).uniform(-2.0, 2.0, (50, len(names)))
    found = chain.forward(joints)
    fixed = np.empty(9)
    mujoco.mju_quat2Mat(fixed, np.array([0.5, 0.1, -0.7, 0.3]) / np.linalg.norm([0.5, 0.1, -0.7, 0.3]))
    for row, values in enumerate(joints):
        data.qpos[:] = values
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        body = data.body("tip")
        rotation = body.xmat.reshape(3, 3)
        point = body.xpos + rotation @ [0.1, -0.05, 0.2]
        linear, angular = np.empty((3, model.nv)), np.empty((3, model.nv))
        mujoco.mj_jac(model, data, linear, angular, point, body.id)
        np.testing.assert_allclose(found.position[row], point, rtol=0, atol=1e-10)
        np.testing.assert_allclose(found.rotation[row], rotation @ fixed.reshape(3, 3), rtol=0, atol=1e-10)
        np.testing.assert_allclose(found.jacobian[row], np.vstack([linear, angular]), rtol=0, atol=1e-10)


def test_the_end_effector_is_between_the_fingertips(arm, model):
    data = mujoco.MjData(model)
    data.qpos[:9] = [*arm.home, 0.03, 0.03]
    mujoco.mj_kinematics(model, data)
    tip = arm.forward(arm.home[None]).position[0]
    pads = np.array([data.geom(f"{side}_pad_{end}").xpos for side in ("left", "right") for end in ("front", "back")])
    np.testing.assert_allclose(pads.mean(axis=0)[:2], tip[:2], rtol=0, atol=1e-5)
    left, right = data.body("left_finger").xpos, data.body("right_finger").xpos
    np.testing.assert_allclose(left - right, [0.0, -0.06, 0.0], rtol=0, atol=1e-6)


def solve_from_home(arm, target):
    return arm.solve(np.tile(arm.home, (target.shape[0], 1)), target, num_iterations=60)


def assert_reached(arm, joints, target, tolerance_m):
    found = arm.forward(joints)
    assert np.linalg.norm(found.position - target, axis=1).max() < tolerance_m
    tilt = np.arccos(np.clip(-found.rotation[:, 2, 2], -1.0, 1.0))
    assert np.degrees(tilt.max()) < 0.5
    np.testing.assert_allclose(
        found.rotation, np.broadcast_to(np.diag([1.0, -1.0, -1.0]), found.rotation.shape), rtol=0, atol=0.01
    )
    assert (joints > JOINT_LOWER).all()
    assert (joints < JOINT_UPPER).all()


@pytest.mark.parametrize(
    ("workspace", "least_share"),
    [(WorkspaceConfig(), 1.0), (WorkspaceConfig(length_x_m=0.45, length_y_m=0.45, height_m=0.4), 0.97)],
    ids=["pre-training", "larger"],
)
def test_inverse_reaches_the_workspace(arm, workspace, least_share):
    target = sample_in_volume(np.random.default_rng(1), 2000, workspace, lowest_m=PANDA.lowest_m)
    within = np.linalg.norm(reach_of(PANDA, arm).clip(target) - target, axis=1) < 1e-9
    assert within.mean() >= least_share
    reachable = target[within]
    assert_reached(arm, solve_from_home(arm, reachable), reachable, 1e-3)


def test_two_iterations_are_enough_for_one_action(arm):
    rng, reach = np.random.default_rng(2), reach_of(PANDA, arm)
    target = sample_in_volume(rng, 2000, WorkspaceConfig(), lowest_m=PANDA.lowest_m)
    displaced = reach.clip(target + rng.uniform(-DISPLACEMENT_M, DISPLACEMENT_M, target.shape))
    solved = arm.forward(arm.solve(solve_from_home(arm, target), displaced))
    error = np.linalg.norm(solved.position - displaced, axis=1)
    assert (error < 1e-3).mean() > 0.99
    assert error.max() < 4e-3  # where the arm is nearly straight


def test_solution_stays_inside_the_limits(arm, joints):
    far = np.random.default_rng(3).uniform(-2.0, 2.0, (200, 3))
    solved = arm.solve(joints, far, num_iterations=5)
    assert (solved > JOINT_LOWER).all()
    assert (solved < JOINT_UPPER).all()


class TestReach:
    @pytest.fixture
    def reach(self, arm):
        return reach_of(PANDA, arm)

    @pytest.fixture
    def target(self):
        return np.random.default_rng(4).uniform((-0.5, -1.0, -0.5), (1.0, 1.0, 1.5), (5000, 3))

    def test_height_first_then_towards_the_base(self, reach, target):
        clipped = reach.clip(target)
        assert clipped[:, 2].min() == PANDA.lowest_m
        fair = (target[:, 2] >= PANDA.lowest_m) & (target[:, 2] <= 0.55)
        np.testing.assert_array_equal(clipped[fair, 2], target[fair, 2])
        base = np.array([-0.6, 0.0])
        before, after = target[:, :2] - base, clipped[:, :2] - base
        cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
        np.testing.assert_allclose(cross, 0.0, rtol=0, atol=1e-12)
        assert ((before * after).sum(axis=1) > 0).all()

    @pytest.mark.parametrize("height_m", [0.05, 0.333 - TIP_M, 0.3, 0.5])
    def test_the_furthest_point_is_where_the_arm_is_nearly_straight(self, reach, height_m):
        """By hand: wrist 0.2104 m above and 0.088 m behind the tip, arm stretched but for 15 mm."""
        arm_m = np.hypot(0.316, 0.0825) + np.hypot(0.384, 0.0825) - 0.015
        furthest_m = 0.088 + np.sqrt(arm_m**2 - (height_m + TIP_M - 0.333) ** 2)
        clipped = reach.clip(np.array([[2.0, 0.0, height_m]]))
        np.testing.assert_allclose(clipped, [[furthest_m - 0.6, 0.0, height_m]], rtol=0, atol=0.008)

    def test_a_clipped_point_ahead_can_be_reached(self, arm, reach):
        ahead = np.random.default_rng(6).uniform((-0.2, -0.4, -0.1), (0.6, 0.4, 0.6), (2000, 3))
        clipped = reach.clip(ahead)
        assert_reached(arm, solve_from_home(arm, clipped), clipped, 1e-3)
