"""Kinematics against a matrix product written from the DH table, MuJoCo's own, and finite differences."""

import mujoco
import numpy as np
import pytest

from service.config import WorkspaceConfig, WorldConfig
from service.envs import kinematics
from service.envs.batch import DISPLACEMENT_M, LOWEST_TARGET_M
from service.envs.panda import BASE_POSITION, JOINT_LOWER, JOINT_UPPER
from service.envs.sampling import sample_in_volume
from service.envs.scene import build_spec

# Franka's table once more, as angles: a, d, alpha of each joint, modified DH.
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


@pytest.fixture
def joints():
    return np.random.default_rng(0).uniform(JOINT_LOWER, JOINT_UPPER, (200, 7))


@pytest.fixture(scope="module")
def model():
    return build_spec(WorldConfig()).compile()


def dh_product(angles):
    """(4, 4) pose of the end effector of one arm, one matrix per joint (Craig 2005, eq. 3.6)."""
    pose = np.eye(4)
    pose[:3, 3] = BASE_POSITION
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
    flange_to_tip = np.eye(4)
    flange_to_tip[2, 3] = TIP_M
    return pose @ flange_to_tip


def test_forward_is_the_dh_product(joints):
    found = kinematics.forward(joints)
    expected = np.stack([dh_product(angles) for angles in joints])
    np.testing.assert_allclose(found.position, expected[:, :3, 3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.rotation, expected[:, :3, :3], rtol=0, atol=1e-9)


def test_forward_is_mujocos_model(joints, model):
    data = mujoco.MjData(model)
    found = kinematics.forward(joints)
    for row, angles in enumerate(joints):
        data.qpos[:7] = angles
        mujoco.mj_kinematics(model, data)
        link = data.body("link7")
        rotation = link.xmat.reshape(3, 3)
        np.testing.assert_allclose(found.position[row], link.xpos + TIP_M * rotation[:, 2], rtol=0, atol=1e-6)
        np.testing.assert_allclose(found.rotation[row], rotation, rtol=0, atol=1e-6)


def test_the_end_effector_is_between_the_fingertips(model):
    data = mujoco.MjData(model)
    data.qpos[:9] = [*kinematics.NEUTRAL_JOINTS, 0.03, 0.03]
    mujoco.mj_kinematics(model, data)
    tip = kinematics.forward(kinematics.NEUTRAL_JOINTS[None]).position[0]
    pads = np.array([data.geom(f"{side}_pad_{end}").xpos for side in ("left", "right") for end in ("front", "back")])
    np.testing.assert_allclose(pads.mean(axis=0)[:2], tip[:2], rtol=0, atol=1e-5)
    left, right = data.body("left_finger").xpos, data.body("right_finger").xpos
    np.testing.assert_allclose(np.abs(left - right), [0.0, 0.06, 0.0], rtol=0, atol=1e-6)


def test_jacobian_is_the_derivative(joints):
    step = 1e-6
    found = kinematics.forward(joints)
    for joint in range(7):
        shift = np.zeros(7)
        shift[joint] = step
        after, before = kinematics.forward(joints + shift), kinematics.forward(joints - shift)
        linear = (after.position - before.position) / (2 * step)
        # R' R^T is the cross-product matrix of the angular velocity.
        skew = np.matmul((after.rotation - before.rotation) / (2 * step), found.rotation.transpose(0, 2, 1))
        angular = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        np.testing.assert_allclose(found.jacobian[:, :3, joint], linear, rtol=0, atol=1e-8)
        np.testing.assert_allclose(found.jacobian[:, 3:, joint], angular, rtol=0, atol=1e-8)


def solve_from_neutral(target):
    start = np.tile(kinematics.NEUTRAL_JOINTS, (target.shape[0], 1))
    return kinematics.solve(start, target, num_iterations=60)


def assert_reached(joints, target, tolerance_m):
    found = kinematics.forward(joints)
    assert np.linalg.norm(found.position - target, axis=1).max() < tolerance_m
    tilt = np.arccos(np.clip(-found.rotation[:, 2, 2], -1.0, 1.0))
    assert np.degrees(tilt.max()) < 0.5
    np.testing.assert_allclose(
        found.rotation, np.broadcast_to(kinematics.DOWN, found.rotation.shape), rtol=0, atol=0.01
    )
    assert (joints > JOINT_LOWER).all()
    assert (joints < JOINT_UPPER).all()


@pytest.mark.parametrize(
    ("workspace", "least_share"),
    [(WorkspaceConfig(), 1.0), (WorkspaceConfig(length_x_m=0.45, length_y_m=0.45, height_m=0.4), 0.97)],
    ids=["pre-training", "larger"],
)
def test_inverse_reaches_the_workspace(workspace, least_share):
    target = sample_in_volume(np.random.default_rng(1), 2000, workspace, 0.05, lowest_m=LOWEST_TARGET_M)
    short = np.linalg.norm(kinematics.clip_to_reach(target, LOWEST_TARGET_M) - target, axis=1)
    reachable = target[short < 1e-9]
    assert len(reachable) >= least_share * len(target)
    assert_reached(solve_from_neutral(reachable), reachable, 1e-3)


def test_two_iterations_are_enough_for_one_action():
    rng = np.random.default_rng(2)
    target = sample_in_volume(rng, 2000, WorkspaceConfig(), 0.05, lowest_m=LOWEST_TARGET_M)
    displaced = target + rng.uniform(-DISPLACEMENT_M, DISPLACEMENT_M, target.shape)
    displaced = kinematics.clip_to_reach(displaced, LOWEST_TARGET_M)
    solved = kinematics.forward(kinematics.solve(solve_from_neutral(target), displaced))
    error = np.linalg.norm(solved.position - displaced, axis=1)
    assert (error < 1e-3).mean() > 0.99
    assert error.max() < 4e-3  # where the arm is nearly straight


def test_known_pose_saves_only_work(joints):
    target = np.tile([0.0, 0.1, 0.2], (200, 1))
    at = kinematics.forward(joints)
    np.testing.assert_array_equal(kinematics.solve(joints, target, at=at), kinematics.solve(joints, target))


def test_solution_stays_inside_the_limits(joints):
    far = np.random.default_rng(3).uniform(-2.0, 2.0, (200, 3))
    solved = kinematics.solve(joints, far, num_iterations=5)
    assert (solved > JOINT_LOWER).all()
    assert (solved < JOINT_UPPER).all()


class TestClipToReach:
    @pytest.fixture
    def target(self):
        return np.random.default_rng(4).uniform((-0.5, -1.0, -0.5), (1.0, 1.0, 1.5), (5000, 3))

    def test_leaves_what_is_reachable(self):
        target = sample_in_volume(np.random.default_rng(5), 2000, WorkspaceConfig(), 0.05, lowest_m=0.025)
        clipped = kinematics.clip_to_reach(target, LOWEST_TARGET_M)
        np.testing.assert_allclose(clipped, target, rtol=0, atol=1e-12)

    def test_does_not_write_to_its_input(self, target):
        before = target.copy()
        kinematics.clip_to_reach(target, LOWEST_TARGET_M)
        np.testing.assert_array_equal(target, before)

    def test_clips_once_and_for_all(self, target):
        once = kinematics.clip_to_reach(target, LOWEST_TARGET_M)
        np.testing.assert_allclose(kinematics.clip_to_reach(once, LOWEST_TARGET_M), once, rtol=0, atol=1e-12)

    def test_height_first_then_towards_the_base(self, target):
        clipped = kinematics.clip_to_reach(target, LOWEST_TARGET_M)
        assert clipped[:, 2].min() == LOWEST_TARGET_M
        fair = (target[:, 2] >= LOWEST_TARGET_M) & (target[:, 2] <= 0.7)
        np.testing.assert_array_equal(clipped[fair, 2], target[fair, 2])
        base = np.asarray(BASE_POSITION[:2])
        before, after = target[:, :2] - base, clipped[:, :2] - base
        cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
        np.testing.assert_allclose(cross, 0.0, rtol=0, atol=1e-12)
        assert ((before * after).sum(axis=1) > 0).all()

    def test_the_furthest_point_by_hand(self):
        # Wrist level with the shoulder, arm stretched but for 15 mm: 0.3266 + 0.3928 - 0.015 m, and 0.088 m to the tip.
        level = 0.333 - TIP_M
        stretched = np.hypot(0.316, 0.0825) + np.hypot(0.384, 0.0825) - 0.015 + 0.088
        clipped = kinematics.clip_to_reach(np.array([[2.0, 0.0, level], [-0.55, 0.0, level]]), LOWEST_TARGET_M)
        np.testing.assert_allclose(clipped, [[stretched - 0.6, 0.0, level], [-0.3, 0.0, level]], rtol=0, atol=1e-12)

    def test_a_clipped_point_ahead_can_be_reached(self):
        ahead = np.random.default_rng(6).uniform((-0.2, -0.4, -0.1), (0.6, 0.4, 0.6), (2000, 3))
        clipped = kinematics.clip_to_reach(ahead, LOWEST_TARGET_M)
        assert_reached(solve_from_neutral(clipped), clipped, 1e-3)
